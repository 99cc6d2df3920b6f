"""What is beyond plain fields: heads, times, conditions, encryption, codecs of our own, tables."""

from __future__ import annotations

import sys
from typing import Any

import pytest
from google.protobuf.descriptor import FieldDescriptor

from messages.dccl import (
    ArithmeticModel,
    BoundFieldCodec,
    Codec,
    DecodeError,
    EncodeError,
    SchemaError,
)
from messages.dccl.options import FieldOptions
from tests.messages.dccl.declare import Declared, declare, number

S = 1_000_000_000


def without(monkeypatch: pytest.MonkeyPatch, *modules: str) -> None:
    for module in modules:
        monkeypatch.setitem(sys.modules, module, None)


# HEAD


def test_the_head_can_be_read_without_the_body() -> None:
    both = declare(number("to", 0, 31, "uint32", in_head=True), number("x", 0, 1000, "uint32"))
    codec = Codec(both)
    data = codec.encode(both(to=9, x=500))
    assert codec.encode_head(both(to=9, x=500)) == data[:2]
    head: Any = codec.decode_head(data[:2])
    assert head.to == 9
    assert not head.HasField("x")


# TIME


@pytest.mark.parametrize("ahead_s", [-43_199, -100, 0, 100, 43_199])
def test_a_time_is_told_within_half_a_window_of_the_receiver_s_clock(ahead_s: int) -> None:
    stamped = declare(
        Declared("t", "double", options={"codec": "dccl.time", "precision": 3}),
        Declared("us", "uint64", options={"codec": "dccl.time", "precision": -3}),
    )
    codec, now_s = Codec(stamped), 1_700_000_123
    sent = stamped(t=now_s + ahead_s, us=(now_s + ahead_s) * 1_000_000)
    assert codec.decode(codec.encode(sent), now_s * S) == sent


def test_a_time_without_a_clock_is_refused() -> None:
    stamped = declare(Declared("t", "double", options={"codec": "dccl.time"}))
    codec = Codec(stamped)
    with pytest.raises(DecodeError, match=r"t is a dccl\.time: decoding it needs now_ns"):
        codec.decode(codec.encode(stamped(t=5)))


# DYNAMIC CONDITIONS

GUARDED = declare(
    Declared("mode", "enum", enum=[("OFF", 1), ("ON", 2)]),
    number("center", -500, 500, "int32"),
    number(
        "near",
        -1000,
        1000,
        "int32",
        "optional",
        dynamic_conditions={
            "only_if": "this.mode == 'N1_ON'",
            "min": "this.center - 8",
            "max": "this.center + 7",
        },
    ),
)


def test_conditions_choose_the_fields_and_their_bounds() -> None:
    pytest.importorskip("lupa")
    codec = Codec(GUARDED)
    on, off = GUARDED(mode=2, center=-300, near=-305), GUARDED(mode=1, center=-300, near=-305)
    assert len(codec.encode(on)) == 1 + 2  # 1 + 10 + 4 bits
    assert codec.decode(codec.encode(on)) == on
    assert not codec.decode(codec.encode(off)).HasField("near")
    with pytest.raises(EncodeError, match="near = 5 is not a value within its bounds -308 to -293"):
        codec.encode(GUARDED(mode=2, center=-300, near=5))
    with pytest.raises(EncodeError, match="near is unset, and a dynamic condition requires it"):
        codec.encode(GUARDED(mode=2, center=-300))


def test_a_script_reaches_nothing_but_the_message() -> None:
    pytest.importorskip("lupa")
    for script in ("os.execute('true') ~= nil", "python.eval('1') == 1", "this.mode.x.y == 1"):
        nosy = declare(
            Declared("mode", "bool"),
            number("x", 0, 1, "int32", "optional", dynamic_conditions={"only_if": script}),
        )
        with pytest.raises(EncodeError, match=r"test\.T\.x: its dynamic condition failed"):
            Codec(nosy).encode(nosy(mode=True, x=1))


def test_a_script_that_is_no_lua_is_refused_at_load() -> None:
    pytest.importorskip("lupa")
    with pytest.raises(SchemaError, match=r"test\.T\.x: omit_if = 'this =' is not Lua"):
        Codec(declare(number("x", 0, 1, "int32", "optional", dynamic_conditions={"omit_if": "this ="})))


def test_conditions_without_lua_say_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    without(monkeypatch, "lupa", "lupa.lua53")
    with pytest.raises(SchemaError, match=r"test\.T\.near .* install straitlink\[lua\]"):
        Codec(GUARDED)


# ENCRYPTION


def test_the_body_is_encrypted_and_the_head_is_not() -> None:
    secret = declare(number("to", 0, 31, "uint32", in_head=True), number("x", 0, 2**30, "uint32"))
    plain, closed = Codec(secret), Codec(secret, insecure_passphrase="sesame")
    sent = secret(to=9, x=123_456_789)
    assert plain.encode(sent)[:2] == closed.encode(sent)[:2]
    assert plain.encode(sent)[2:] != closed.encode(sent)[2:]
    assert closed.decode(closed.encode(sent)) == sent


# CODECS FROM OUTSIDE


class Nibbles:
    """Numbers of 4 bits, the list's length in 4 bits before them."""

    def bind(self, field: FieldDescriptor, options: FieldOptions) -> BoundFieldCodec | None:
        return BoundNibbles(4 * (1 + (options.max_repeat or 1))) if field.is_repeated else None


class BoundNibbles:
    def __init__(self, max_bits: int) -> None:
        self.min_bits, self.max_bits = 4, max_bits

    def encode(self, value: Any) -> tuple[int, int]:
        return sum(v << 4 * i for i, v in enumerate([len(value), *value])), 4 * (1 + len(value))

    def decode(self, bits: int, available: int) -> tuple[Any, int]:
        count = bits & 15
        return [bits >> 4 * (1 + i) & 15 for i in range(count)], 4 * (1 + count)


def test_a_codec_of_our_own_serves_a_field_and_leaves_others_to_dccl() -> None:
    mixed = declare(
        number("a", 0, 15, "uint32", label="repeated", max_repeat=5),
        number("b", 0, 3, "uint32"),
        codec_group="acme.1",
    )
    codec = Codec(mixed, field_codecs={"acme.1": Nibbles()})
    sent = mixed(a=[1, 15, 7], b=2)
    assert codec.encode(sent) == bytes([10, 0x13, 0x7F, 0x02])
    assert codec.decode(codec.encode(sent)) == sent
    with pytest.raises(DecodeError, match=r"1 bytes are fewer|bytes end within"):
        codec.decode(bytes([10, 0x15]))


def test_a_codec_of_our_own_within_a_oneof_takes_bits_only_when_it_is_chosen() -> None:
    members = [
        Declared("a", "uint32", "optional", {"codec": "acme.byte"}, oneof="which"),
        Declared("b", "uint32", "optional", {"min": 0, "max": 3}, oneof="which"),
    ]
    chosen = declare(*members)
    codec = Codec(chosen, field_codecs={"acme.byte": Bytes()})
    for sent, size in ((chosen(a=200), 3), (chosen(b=2), 2), (chosen(), 2)):
        assert len(codec.encode(sent)) == size
        assert codec.decode(codec.encode(sent)) == sent


class Bytes:
    """A number of 8 bits; a codec may be its own bound codec where it needs nothing of the field."""

    min_bits = max_bits = 8

    def bind(self, field: FieldDescriptor, options: FieldOptions) -> BoundFieldCodec | None:
        return self

    def encode(self, value: Any) -> tuple[int, int]:
        return value or 0, 8

    def decode(self, bits: int, available: int) -> tuple[Any, int]:
        return bits & 255, 8


# ARITHMETIC


def test_a_message_that_was_refused_teaches_an_adaptive_model_nothing() -> None:
    model = ArithmeticModel("m", (1, 1, 1, 1), (0, 1, 2, 3, 4), is_adaptive=True)
    lists = declare(
        Declared("v", "int32", "repeated", {"codec": "dccl.arithmetic", "max_repeat": 9, "arithmetic": "m"}),
        number("x", 0, 1, precision=1),
    )
    sender, receiver = (Codec(lists, arithmetic_models=[model]) for _ in range(2))
    sizes = []
    for _ in range(20):
        with pytest.raises(EncodeError):
            sender.encode(lists(v=[2] * 9, x=float("nan")))
        with pytest.raises(DecodeError):
            receiver.decode(b"\x0a")
        sent = lists(v=[3] * 9, x=0.5)
        data = sender.encode(sent)
        sizes.append(len(data))
        assert receiver.decode(data) == sent
    assert sizes[-1] < sizes[0]


def test_rare_values_cost_more_bits_than_common_ones() -> None:
    model = ArithmeticModel("m", (1000, 10, 10, 1), (0, 1, 2, 3, 4), eof_frequency=10)
    lists = declare(
        Declared("v", "int32", "repeated", {"codec": "dccl.arithmetic", "max_repeat": 30, "arithmetic": "m"}),
        number("tail", 0, 255, "uint32"),
    )
    codec = Codec(lists, arithmetic_models=[model])
    common, rare = lists(v=[0] * 30, tail=7), lists(v=[3] * 30, tail=7)
    assert len(codec.encode(common)) <= 4
    assert len(codec.encode(common)) < len(codec.encode(rare)) <= codec.max_size
    assert codec.decode(codec.encode(common)) == common
    assert codec.decode(codec.encode(rare)) == rare
    with pytest.raises(EncodeError, match=r"test\.T\.v = 9 is not within 0 to 4"):
        codec.encode(lists(v=[9], tail=7))


# TABLES AND HASHES


def test_the_budget_names_each_field_with_its_bits_and_the_total() -> None:
    pose = declare(
        number("x", -1000, 1000, precision=3, units={"derived_dimensions": "length", "unit": "m"}),
        Declared("inner", "message", "optional", message=[number("n", 0, 7, "uint32")]),
    )
    info = Codec(pose).info()
    assert [(f.path, f.min_bits, f.max_bits) for f in info.fields] == [
        ("x", 21, 21),
        ("inner", 1, 4),
        ("inner.n", 3, 3),
    ]
    assert (info.fields[0].unit, info.fields[0].resolution) == ("m", 0.001)
    assert (info.min_bytes, info.max_bytes, info.max_bytes_allowed) == (4, 5, 10_000)
    assert "x        double" in str(info) and "-1000 .. 1000" in str(info) and "total 4..5 bytes" in str(info)


def test_the_schema_hash_changes_with_what_changes_the_bytes_and_not_with_units() -> None:
    def hash_of(**options: Any) -> int:
        return Codec(declare(number("x", -1, 1, **options))).schema_hash

    assert hash_of(precision=2) == hash_of(precision=2, description="across", units={"unit": "m"})
    assert hash_of(precision=2) != hash_of(precision=3)


def test_a_hash_field_tells_another_schema() -> None:
    def hashed(high: int) -> Codec[Any]:
        return Codec(
            declare(number("h", 0, 65535, "uint32", codec="dccl.hash"), number("x", 0, high, "uint32"))
        )

    a, b = hashed(7), hashed(6)
    data = a.encode(a.message_type(h=0, x=5))
    assert a.decode(data).x == 5
    with pytest.raises(DecodeError, match="h: the sender has another schema"):
        b.decode(data)

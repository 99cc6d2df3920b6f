"""Differences against acknowledged messages: nothing stalls after a loss, nothing comes out wrong."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
from google.protobuf.message import Message
from hypothesis import given, settings
from hypothesis import strategies as st

from messages.dccl import Codec, DecodeError, EncodeError, SchemaError
from messages.delta import DeltaDecoder, DeltaEncoder
from tests.messages.dccl.declare import Declared, declare, number

NOW_NS = 1_700_000_000 * 10**9
QUATERNION = {"codec": "straitlink.quaternion.1", "resolution": 0.002, "min_repeat": 4, "max_repeat": 4}


def joints_type() -> type[Message]:
    return declare(
        Declared("t", "double", "required", {"codec": "straitlink.time.1", "max": 60, "resolution": 0.001}),
        Declared("q", "double", "repeated", QUATERNION),
        number("j", -4, 4, "double", "repeated", resolution=0.001, min_repeat=12, max_repeat=12),
        Declared("mode", "enum", "required", enum=[("A", 3), ("B", 1), ("C", 7)]),
        codec_group="straitlink.1",
    )


JOINTS = Codec(joints_type())
PLAIN = Codec(
    declare(number("x", -10, 10, precision=3), number("y", 0, 100, "uint32", "optional"), version=3)
)


def joints_at(n: int) -> Message:
    turn = n / 15
    return JOINTS.message_type(
        t=1_700_000_000 + n / 10,
        q=[math.sin(turn / 2), 0, 0, math.cos(turn / 2)],
        j=[1.5 * math.sin(n / 60 + k) for k in range(12)],
        mode=3 if n < 30 else 7,
    )


def through_the_codec(codec: Codec[Any], message: Message) -> Message:
    return codec.decode(codec.encode(message), NOW_NS)


Motion = Callable[[int], Message]


def motion(joints: Callable[[int], list[float]], t: Callable[[int], float] = lambda n: n / 10) -> Motion:
    return lambda n: JOINTS.message_type(t=1_700_000_000 + t(n), q=[0, 0, 0, 1], j=joints(n), mode=3)


def trotting(n: int) -> list[float]:
    """2 Hz, seen at 10 Hz."""
    return [0.4 * math.sin(4 * math.pi * n / 10 + 0.7 * k) for k in range(12)]


def jumping(n: int) -> list[float]:
    return [(-3.9 if n // 7 % 2 else 3.9) if k < 7 else 0.1 for k in range(12)]


def stuck(n: int) -> list[float]:
    return [0.0005 * k * n if k else 1.234 for k in range(12)]


def turning(n: int) -> list[float]:
    """Continuous joints pass from pi to -pi."""
    return [math.remainder(0.3 * n + k, 2 * math.pi) for k in range(12)]


MOTIONS = {
    "trotting": motion(trotting),
    "jumping": motion(jumping),
    "stuck": motion(stuck),
    "turning": motion(turning),
    "a clock that steps back": motion(stuck, lambda n: n / 10 if n < 20 else n / 10 - 7.123),
    "a clock that stands": motion(trotting, lambda n: 0.0),
}


def exchange(
    count: int, lost: set[int], round_trip: int = 4, at: Motion = joints_at
) -> tuple[list[int], int]:
    """Sizes of a stream whose acknowledgements come `round_trip` messages later, and how many arrived."""
    encoder, decoder = DeltaEncoder(JOINTS), DeltaDecoder(JOINTS)
    sizes = []
    for n in range(count):
        if n >= round_trip and n - round_trip not in lost:
            encoder.on_acknowledged(n - round_trip)
        data = encoder.encode(at(n), n)
        sizes.append(len(data))
        if n not in lost:
            assert decoder.decode(data, n, NOW_NS) == through_the_codec(JOINTS, at(n))
    assert decoder.counters.decoded == count - len(lost)
    return sizes, decoder.counters.decoded


# WHAT ARRIVES DECODES


@settings(max_examples=30)
@given(st.sets(st.integers(0, 39)), st.integers(1, 20))
def test_whatever_is_lost_all_that_arrives_decodes_as_it_comes(lost: set[int], round_trip: int) -> None:
    exchange(40, lost, round_trip)


@pytest.mark.parametrize("name", MOTIONS)
@pytest.mark.parametrize("round_trip", [1, 10])
def test_any_motion_comes_through_and_costs_no_more_than_alone(name: str, round_trip: int) -> None:
    sizes, _ = exchange(50, {3, 4, 17, 31}, round_trip, MOTIONS[name])
    assert max(sizes) <= DeltaEncoder(JOINTS).max_size


def test_joints_that_move_together_cost_half_of_what_each_by_itself_would(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    together = sum(exchange(60, set(), 3, MOTIONS["trotting"])[0][20:])
    monkeypatch.setattr("messages.delta.encoder.leanings", lambda *_: {})
    assert together < 0.5 * sum(exchange(60, set(), 3, MOTIONS["trotting"])[0][20:])


def test_a_motion_costs_less_than_half_of_what_it_costs_alone() -> None:
    sizes, _ = exchange(60, set(), round_trip=1)
    assert max(sizes) <= DeltaEncoder(JOINTS).max_size
    assert sum(sizes[20:]) / 40 < 0.55 * sizes[0]


def test_what_stands_still_costs_next_to_nothing() -> None:
    encoder = DeltaEncoder(JOINTS)
    for n in range(60):
        data = encoder.encode(joints_at(5), n)
        encoder.on_acknowledged(n)
    assert len(data) <= 5


@settings(max_examples=40)
@given(st.permutations(range(6)), st.data())
def test_messages_that_overtake_each_other_decode_if_their_references_are_there(
    order: list[int], data: st.DataObject
) -> None:
    encoder, decoder = DeltaEncoder(JOINTS), DeltaDecoder(JOINTS)
    for n in range(10):
        decoder.decode(encoder.encode(joints_at(n), n), n, NOW_NS)
        encoder.on_acknowledged(n)
    sent = {n: encoder.encode(joints_at(n), n) for n in range(10, 16)}
    for n in order:
        assert decoder.decode(sent[10 + n], 10 + n, NOW_NS) == through_the_codec(JOINTS, joints_at(10 + n))
    again = data.draw(st.integers(10, 15))
    assert decoder.decode(sent[again], again, NOW_NS) == through_the_codec(JOINTS, joints_at(again))


def test_a_joint_at_its_limit_decodes_where_the_limit_is_no_exact_double() -> None:
    """0.4700568 is 1394 * 0.0003372, which comes out as 0.47005680000000005."""
    bounds = {"min": -0.9101028, "max": 0.4700568, "resolution": 0.0003372}
    codec = Codec(declare(Declared("x", "double", "optional", bounds)))
    encoder, decoder = DeltaEncoder(codec), DeltaDecoder(codec)
    for n, x in enumerate([0.1, 0.4700568, -0.9101028, 0.4700568, None]):
        sent = codec.message_type(x=x)
        assert decoder.decode(encoder.encode(sent, n), n) == through_the_codec(codec, sent)
        encoder.on_acknowledged(n)


def test_a_schema_of_plain_dccl_works_as_well() -> None:
    encoder, decoder = DeltaEncoder(PLAIN), DeltaDecoder(PLAIN)
    for n, (x, y) in enumerate([(0, None), (0.001, 0), (9.9994, 100), (-10, None), (-10, 7)]):
        sent = PLAIN.message_type(x=x, y=y)
        assert decoder.decode(encoder.encode(sent, n), n) == through_the_codec(PLAIN, sent)
        encoder.on_acknowledged(n)


@st.composite
def shapes(draw: st.DrawFn) -> list[Message]:
    """Messages whose parts come and go."""
    made = []
    for _ in range(draw(st.integers(2, 6))):
        message = SHAPES.message_type(ok=draw(st.booleans()))
        message.v.extend(draw(st.lists(st.integers(-3, 10**6), max_size=4)))
        if draw(st.booleans()):
            message.inner.a = draw(st.floats(0, 1))
            if draw(st.booleans()):
                message.inner.b = draw(st.integers(-(2**62), 2**62))
        which = draw(st.sampled_from(["", "c", "d"]))
        if which:
            setattr(message, which, draw(st.integers(0, 9)))
        if draw(st.booleans()):
            message.q.extend(draw(st.sampled_from([[1, 0, 0, 0], [0, 0.6, -0.8, 0], [0.5, 0.5, 0.5, 0.5]])))
        made.append(message)
    return made


SHAPES = Codec(
    declare(
        Declared("ok", "bool"),
        number("v", -3, 10**6, "int32", "repeated", max_repeat=4),
        Declared(
            "inner",
            "message",
            "optional",
            message=[number("a", 0, 1, resolution=0.25), number("b", -(2**62), 2**62, "int64", "optional")],
        ),
        Declared("c", "uint32", "optional", {"min": 0, "max": 9}, oneof="which"),
        Declared("d", "uint32", "optional", {"min": 0, "max": 9}, oneof="which"),
        Declared("q", "double", "repeated", {**QUATERNION, "min_repeat": 0}),
        Declared("kind", "string", "required", {"codec": "dccl.static", "static_value": "arm"}),
        codec_group="straitlink.1",
    )
)


@settings(max_examples=60)
@given(shapes())
def test_parts_that_come_and_go_come_back_as_they_were(sent: list[Message]) -> None:
    encoder, decoder = DeltaEncoder(SHAPES), DeltaDecoder(SHAPES)
    for n, message in enumerate(sent):
        message.kind = "arm"
        assert decoder.decode(encoder.encode(message, n), n) == through_the_codec(SHAPES, message)
        encoder.on_acknowledged(n)


# WHAT CANNOT BE KNOWN IS DROPPED, AND NOTHING ELSE


def started(count: int) -> tuple[DeltaEncoder[Message], DeltaDecoder[Message]]:
    encoder, decoder = DeltaEncoder(JOINTS), DeltaDecoder(JOINTS)
    for n in range(count):
        decoder.decode(encoder.encode(joints_at(n), n), n, NOW_NS)
        encoder.on_acknowledged(n)
    return encoder, decoder


def test_a_message_without_its_reference_is_dropped_and_counted() -> None:
    encoder, _ = started(10)
    newcomer = DeltaDecoder(JOINTS)
    with pytest.raises(DecodeError, match="needs 9, which is not here"):
        newcomer.decode(encoder.encode(joints_at(10), 10), 10, NOW_NS)
    assert newcomer.counters.reference_missing == 1


def test_a_receiver_that_started_anew_is_in_business_with_the_next_message_once_that_is_known() -> None:
    encoder, _ = started(10)
    newcomer = DeltaDecoder(JOINTS)
    encoder.reset()
    assert newcomer.decode(encoder.encode(joints_at(10), 10), 10, NOW_NS) == through_the_codec(
        JOINTS, joints_at(10)
    )


def test_a_receiver_that_fails_unnoticed_is_helped_within_256_messages() -> None:
    encoder, _ = started(10)
    newcomer = DeltaDecoder(JOINTS)
    came = 0
    for n in range(10, 300):
        data = encoder.encode(joints_at(n), n)
        encoder.on_acknowledged(n)  # whoever acknowledges does not know that it could not be decoded
        try:
            newcomer.decode(data, n, NOW_NS)
            came += 1
        except DecodeError:
            pass
    assert came >= 40
    assert newcomer.counters.mismatched == 0


@settings(max_examples=30)
@given(st.integers(1, 8), st.integers(0, 2**32))
def test_a_sender_that_started_anew_unnoticed_is_never_taken_for_the_former(back: int, seed: int) -> None:
    """The receiver holds messages under the numbers that the new sender refers to; 24 bits tell."""
    encoder, decoder = DeltaEncoder(JOINTS, check_bits=24), DeltaDecoder(JOINTS, check_bits=24)
    former = DeltaEncoder(JOINTS, check_bits=24)
    for n in range(10):
        decoder.decode(former.encode(joints_at(100 + seed % 1000 + n), n), n, NOW_NS)
        encoder.encode(joints_at(n), n)
        encoder.on_acknowledged(n)
    data = encoder.encode(joints_at(9 + back), 9 + back)
    with pytest.raises(DecodeError, match="check"):
        decoder.decode(data, 9 + back, NOW_NS)
    assert decoder.counters.mismatched == 1


def test_the_check_lets_one_mismatch_in_256_through_at_most() -> None:
    encoder, decoder = started(10)
    data = encoder.encode(joints_at(10), 10)
    passed = 0
    for i in range(len(data)):
        for bit in range(8):
            damaged = bytearray(data)
            damaged[i] ^= 1 << bit
            try:
                decoder.decode(bytes(damaged), 10, NOW_NS)
                passed += 1
            except DecodeError:
                pass
    assert passed <= 3  # of some 200 single flipped bits


@given(st.binary(max_size=80), st.integers(-5, 100))
def test_any_bytes_decode_or_raise_decode_error(data: bytes, number_: int) -> None:
    _, decoder = started(3)
    try:
        decoder.decode(data, number_, NOW_NS)
    except DecodeError:
        assert decoder.counters.mismatched + decoder.counters.reference_missing <= 1


def test_neither_end_keeps_more_than_a_window_of_messages() -> None:
    encoder, decoder = started(400)
    assert len(encoder._sent) <= 72 and len(encoder._held) <= 72
    assert len(decoder._samples) <= 144


# STRICTNESS


def test_a_value_out_of_range_is_a_decision_as_in_the_codec() -> None:
    wild = joints_at(0)
    wild.j[3] = math.nan
    with pytest.raises(EncodeError, match=r"j.* = nan"):
        DeltaEncoder(JOINTS).encode(wild, 0)
    wild.j[3] = 5
    lenient = Codec(joints_type(), out_of_range="clamp")
    sent = lenient.message_type.FromString(wild.SerializeToString())
    encoded = DeltaEncoder(lenient).encode_checked(sent, 0)
    assert [d.what for d in encoded.deviations] == ["clamped to its nearest bound"]
    assert DeltaDecoder(lenient).decode(encoded.data, 0, NOW_NS).j[3] == 4


def test_a_message_that_was_refused_leaves_no_trace() -> None:
    encoder, decoder = started(5)
    wild = joints_at(5)
    wild.j[0] = 99
    with pytest.raises(EncodeError):
        encoder.encode(wild, 5)
    assert decoder.decode(encoder.encode(joints_at(5), 5), 5, NOW_NS) == through_the_codec(
        JOINTS, joints_at(5)
    )


@pytest.mark.parametrize(
    ("field", "what"),
    [
        (Declared("s", "string", "required", {"max_length": 5}), "s is no number"),
        (Declared("m", "message", "repeated", {"max_repeat": 2}, [number("x", 0, 1)]), "m is no number"),
    ],
)
def test_a_field_without_a_lane_is_named(field: Declared, what: str) -> None:
    with pytest.raises(SchemaError, match=what):
        DeltaEncoder(Codec(declare(field)))


# THE BYTES


def test_the_bytes_are_these() -> None:
    """Changing them is a decision: both ends must agree to the bit."""
    encoder = DeltaEncoder(JOINTS)
    seen = []
    for n in range(12):
        seen.append(encoder.encode(joints_at(n), n).hex())
        if n != 6:
            encoder.on_acknowledged(n)
    assert [seen[0], seen[1], seen[8], seen[11]] == GOLDEN


GOLDEN: list[str] = [
    "037ac31a9dc033c3bf1f56548d17976ef7d731d8c6641c6f36bddfec",
    "1f4f2261825ba7e27009b988cd332b2c83ca",
    "1e778ff80f8c1836",
    "1ac909c9188d56",
]

"""straitlink.1: exact steps, shared bounds, quaternions, times in a window, lists coded by their spread."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import pytest
from google.protobuf.message import Message
from hypothesis import given
from hypothesis import strategies as st

from messages.dccl import Codec, DecodeError, EncodeError, SchemaError
from messages.dccl.straitlink.quaternion import QuaternionSteps
from messages.dccl.straitlink.steps import Steps
from tests.messages.dccl.declare import Declared, declare, number

S = 1_000_000_000
GROUP = {"codec_group": "straitlink.1"}
QUATERNION = {"codec": "straitlink.quaternion.1", "resolution": 0.002}


def own(*fields: Declared, **options: Any) -> type[Message]:
    return declare(*fields, **{**GROUP, **options})


def exact(name: str, type_name: str = "double", label: str = "required", **options: Any) -> Declared:
    return Declared(name, type_name, label, {"exact": options})


def quaternion_field(label: str = "required") -> Declared:
    parts = [Declared(name, "double") for name in "xyzw"]
    return Declared("q", "message", label, QUATERNION, parts)


# STEPS


@given(
    st.fractions(-1000, 1000, max_denominator=10**6),
    st.integers(0, 10**6),
    st.fractions(Fraction(1, 1000), 10, max_denominator=10**6),
    st.floats(0, 1),
)
def test_a_value_comes_back_within_half_a_step(low: Fraction, count: int, step: Fraction, at: float) -> None:
    high = low + count * step * Fraction(9, 10)
    steps = Steps(low, high, step, False)
    value = float(low + (high - low) * Fraction(at))
    index = steps.index(value)
    error = abs(Fraction(steps.value(index)) - Fraction(value))
    assert error <= step / 2 + Fraction(1, 10**8)
    assert steps.index(steps.value(index)) == index


@given(
    st.fractions(-(10**9), 10**9, max_denominator=10**9),
    st.integers(1, 2**50),
    st.fractions(Fraction(1, 10**9), 10**6, max_denominator=10**9),
    st.floats(0, 1),
)
def test_the_nearest_step_is_that_of_exact_arithmetic(
    low: Fraction, count: int, step: Fraction, at: float
) -> None:
    steps = Steps(low, low + count * step, step, False)
    near = low + step * (math.floor(count * Fraction(at)) + Fraction(1, 2))  # a halfway case, or beside one
    for value in (
        float(near),
        math.nextafter(float(near), math.inf),
        float(low + count * step * Fraction(at)),
    ):
        if low <= Fraction(value) <= low + count * step:
            exact = math.floor((Fraction(value) - low) / step + Fraction(1, 2))
            assert steps.index(value) == min(exact, count)


def test_a_halfway_case_is_judged_by_the_values_own_bits() -> None:
    # 0.15 is a little less than 15/100 in binary, and 0.25 is exactly halfway: both decided without noise.
    steps = Steps(Fraction(0), Fraction(1), Fraction(1, 10), False)
    assert steps.index(0.15) == (1 if Fraction(0.15) < Fraction(15, 100) else 2)
    assert steps.index(0.25) == 3
    assert Steps(Fraction(-1), Fraction(0), Fraction(1, 10), False).index(-0.25) == 8


def test_twelve_bits_are_4096_steps_from_bound_to_bound() -> None:
    joint = own(exact("x", min="-2.0944", max="1/3", steps=4096))
    codec = Codec(joint)
    assert codec.info().fields[0].max_bits == 12
    for bound in (-2.0944, 1 / 3):
        assert codec.decode(codec.encode(joint(x=bound))) == joint(x=bound)


def test_the_maximum_is_a_step_wherever_it_lies() -> None:
    codec = Codec(own(number("x", 0, 1, resolution=0.3)))
    assert [codec.decode(codec.encode(codec.message_type(x=x))).x for x in (0.89, 0.94, 0.96, 1)] == [
        0.9,
        0.9,
        1,
        1,
    ]


def test_a_float_at_its_own_bound_is_in_range() -> None:
    codec = Codec(own(number("x", -0.05, 0.05, "float", resolution=0.01)))
    sent = codec.message_type(x=0.05)
    assert codec.decode(codec.encode(sent)) == sent


@given(st.lists(st.integers(0, 2), min_size=3, max_size=11))
def test_a_list_of_three_steps_takes_the_bits_of_its_combinations(values: list[int]) -> None:
    codec = Codec(own(number("v", 0, 2, "int32", "repeated", min_repeat=3, max_repeat=11)))
    sent = codec.message_type(v=values)
    data = codec.encode(sent)
    assert len(data) == 1 + math.ceil((4 + math.ceil(len(values) * math.log2(3))) / 8)
    assert codec.decode(data) == sent


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1.01, -0.01])
@pytest.mark.parametrize("label", ["required", "optional", "repeated"])
def test_a_number_beyond_its_bounds_is_a_decision(value: float, label: str) -> None:
    message_type = own(number("x", 0, 1, label=label, resolution=0.125, max_repeat=3))
    is_list = label == "repeated"
    sent = message_type(x=[0.5, value] if is_list else value)
    where = r"x\[1\]" if is_list else "x"
    with pytest.raises(EncodeError, match=f"{where} = "):
        Codec(message_type).encode(sent)
    lax = Codec(message_type, out_of_range="dccl").encode_checked(sent)
    assert len(lax.deviations) == 1
    if math.isnan(value):
        with pytest.raises(EncodeError):
            Codec(message_type, out_of_range="clamp").encode(sent)
        return
    codec = Codec(message_type, out_of_range="clamp")
    clamped = codec.encode_checked(sent)
    got = codec.decode(clamped.data).x
    assert (got[1] if is_list else got) == (1 if value > 0 else 0)
    assert [d.what for d in clamped.deviations] == ["clamped to its nearest bound"]


@pytest.mark.parametrize(
    ("field", "what"),
    [
        (number("x", 0, 1, resolution=0), "greater than 0"),
        (number("x", 1, 0), "exceeds max"),
        (number("x", 0, 1, "int32", resolution=0.5), "must be integers"),
        (number("x", 0, 1e9, "float", resolution=0.001), "finer than a float"),
        (exact("x", min="zero", max="1"), "not a number such as"),
        (exact("x", min="1/0", max="1"), "not a number such as"),
        (exact("x", min="0", max="1", steps=1), "at least 2"),
        (exact("x", min="0", max="1", steps=9, resolution="1"), "exclude each other"),
        (Declared("x", "double", "required", {"min": 0, "max": 1, "exact": {"min": "0"}}), "stated twice"),
        (number("x", 0, 1, codec="straitlink.adaptive.1"), "for repeated fields"),
        (number("x", 0, 1, "int32", codec="straitlink.quaternion.1"), "max_repeat 4"),
        (number("x", 1, 9, codec="straitlink.time.1"), "its window"),
        (Declared("x", "string", "required", {"codec": "straitlink.adaptive.1"}), "for numbers"),
        (
            Declared("x", "int64", "required", {"codec": "straitlink.time.1", "max": 10, "resolution": 3}),
            "2 to 2",
        ),
        (number("x", 0, 1, label="repeated"), "max_repeat"),
    ],
)
def test_a_declaration_that_makes_no_sense_says_why(field: Declared, what: str) -> None:
    with pytest.raises(SchemaError, match=what):
        Codec(own(field))


def test_the_group_needs_version_4() -> None:
    with pytest.raises(SchemaError, match="codec_version 4"):
        Codec(own(number("x", 0, 1), version=3))


# QUATERNIONS


def angle_rad(p: Any, q: Any) -> float:
    difference = min(math.dist(p, q), math.dist(p, [-c for c in q]))
    return 4 * math.asin(min(1.0, difference / 2))


@given(st.tuples(*[st.floats(-1, 1)] * 4), st.sampled_from([0.1, 0.01, 0.002, 1e-5, 1e-7]))
def test_a_quaternion_turns_by_no_more_than_its_stated_error(q: Any, error_rad: float) -> None:
    norm = math.hypot(*q)
    unit = [c / norm for c in q] if norm > 1e-3 else [0.5, 0.5, -0.5, 0.5]
    steps = QuaternionSteps(error_rad)
    back = steps.quaternion(*steps.digits(unit))
    assert back is not None
    assert abs(math.hypot(*back) - 1) < 1e-12
    assert angle_rad(unit, back) <= error_rad


def test_the_worst_quaternions_stay_within_the_error() -> None:
    # All four components alike, and half a step off: where the bound is nearly reached.
    steps = QuaternionSteps(0.1)
    worst = 0.0
    for shift in range(-60, 61):
        q = [0.5 + shift * steps.step / 40, 0.5, 0.5 - shift * steps.step / 50, 0.5 + 1e-9]
        unit = [c / math.hypot(*q) for c in q]
        back = steps.quaternion(*steps.digits(unit))
        assert back is not None
        worst = max(worst, angle_rad(unit, back))
    assert 0.03 < worst <= 0.1


def test_a_quaternion_in_a_message_and_in_a_list_takes_36_bits_at_2_mrad() -> None:
    listed = Declared("v", "double", "repeated", {**QUATERNION, "max_repeat": 4, "min_repeat": 4})
    codec = Codec(own(quaternion_field(), listed))
    assert [row.max_bits for row in codec.info().fields] == [36, 36]
    sent = codec.message_type(v=[0, 0, 0, 1])
    sent.q.x, sent.q.y, sent.q.z, sent.q.w = -1, 0, 0, 0
    got = codec.decode(codec.encode(sent))
    assert list(got.v) == [0, 0, 0, 1]
    assert (got.q.x, got.q.y, got.q.z, got.q.w) == (1, 0, 0, 0)  # the same orientation


def test_an_unset_quaternion_stays_unset() -> None:
    codec = Codec(own(quaternion_field("optional"), number("x", 0, 1)))
    sent = codec.message_type(x=1)
    assert codec.decode(codec.encode(sent)) == sent


@pytest.mark.parametrize("w", [0.0, 0.9, 1.1, math.nan, math.inf])
def test_what_is_no_unit_quaternion_is_refused(w: float) -> None:
    codec = Codec(own(quaternion_field()))
    sent = codec.message_type()
    sent.q.x = sent.q.y = sent.q.z = 0
    sent.q.w = w
    with pytest.raises(EncodeError, match="no unit quaternion"):
        codec.encode(sent)


# TIMES


@given(st.integers(0, 2**50), st.integers(-29_999, 29_999), st.sampled_from(["int64", "uint64", "double"]))
def test_a_time_is_the_one_nearest_to_the_receivers_clock(
    sent_ms: int, ahead_ms: int, type_name: str
) -> None:
    is_double = type_name == "double"
    options = {"codec": "straitlink.time.1", "max": 60, "resolution": 0.001}
    if not is_double:
        options = {
            "codec": "straitlink.time.1",
            "max": 60_000_000_000,
            "resolution": 1_000_000,
            "exact": {"per_second": S},
        }
    sent_ms %= 2**41 if is_double else 2**43
    codec = Codec(own(Declared("t", type_name, "required", options)))
    sent = codec.message_type(t=sent_ms / 1000 if is_double else sent_ms * 1_000_000)
    data = codec.encode(sent)
    assert len(data) == 3
    assert codec.decode(data, now_ns=(sent_ms + ahead_ms) * 1_000_000) == sent


def test_a_time_needs_the_clock_and_must_be_one() -> None:
    codec = Codec(own(Declared("t", "double", "required", {"codec": "straitlink.time.1", "max": 60})))
    with pytest.raises(DecodeError, match="now_ns"):
        codec.decode(codec.encode(codec.message_type(t=5)))
    with pytest.raises(EncodeError, match="not a time"):
        codec.encode(codec.message_type(t=math.nan))


# LISTS BY THEIR SPREAD


ADAPTIVE = {"codec": "straitlink.adaptive.1", "max_repeat": 200}


@given(st.lists(st.integers(-(10**6), 10**6), max_size=40))
def test_a_list_comes_back_whatever_its_values(values: list[int]) -> None:
    codec = Codec(own(number("v", -(10**6), 10**6, "int32", "repeated", **ADAPTIVE), number("x", 0, 9)))
    sent = codec.message_type(v=values, x=3)
    data = codec.encode(sent)
    assert codec.schema.min_bytes <= len(data) <= codec.schema.max_bytes
    assert codec.decode(data) == sent


def test_a_smooth_list_takes_less_than_half_and_a_wild_one_hardly_more() -> None:
    adaptive = Codec(own(number("v", -100, 100, "double", "repeated", resolution=0.01, **ADAPTIVE)))
    packed = Codec(own(number("v", -100, 100, "double", "repeated", resolution=0.01, max_repeat=200)))
    smooth = [90 * math.sin(i / 20) for i in range(200)]
    wild = [90 * math.sin(i * i) for i in range(200)]
    assert len(adaptive.encode(adaptive.message_type(v=smooth))) < 0.5 * len(
        packed.encode(packed.message_type(v=smooth))
    )
    assert (
        len(adaptive.encode(adaptive.message_type(v=wild)))
        <= len(packed.encode(packed.message_type(v=wild))) + 1
    )


# HOSTILE BYTES


def everything() -> type[Message]:
    return own(
        Declared("t", "double", "required", {"codec": "straitlink.time.1", "max": 60, "resolution": 0.001}),
        quaternion_field("optional"),
        number("u", -1, 1, "float", "repeated", resolution=0.1, min_repeat=1, max_repeat=5),
        number("v", -9, 9, "int32", "repeated", codec="straitlink.adaptive.1", max_repeat=20),
        number("x", 0, 4, "uint32", "optional"),
        Declared("name", "string", "optional", {"max_length": 5}),
    )


EVERYTHING = Codec(everything(), strict=False)


@given(st.binary(max_size=60))
def test_any_bytes_decode_or_raise_decode_error(data: bytes) -> None:
    for start in (b"", b"\x0a"):
        try:
            message, taken = EVERYTHING.decode_prefix(start + data, now_ns=10**18)
        except DecodeError:
            continue
        assert taken <= len(start + data)
        assert EVERYTHING.decode(EVERYTHING.encode(message), now_ns=10**18) is not None


def test_another_declaration_has_another_hash() -> None:
    hashes = {
        Codec(own(*fields)).schema_hash
        for fields in (
            [number("x", 0, 1)],
            [number("x", 0, 2)],
            [exact("x", min="0", max="1", steps=3)],
            [Declared("x", "double", "required", {"codec": "straitlink.time.1", "max": 60})],
            [quaternion_field()],
            [quaternion_field("optional")],
        )
    }
    assert len(hashes) == 6
    assert Codec(own(quaternion_field())).schema_hash == Codec(own(quaternion_field())).schema_hash

"""The short form that compiled code uses is the long one that DCCL's C++ computes."""

from __future__ import annotations

import math

from hypothesis import given, settings
from hypothesis import strategies as st

from messages.dccl.numeric import Numeric, make_numeric, to_float32


def long_form(n: Numeric, value: float) -> int | None:
    """Section 6 of the specification, word for word, for floats."""
    cast = to_float32 if n.number_type == "float" else float

    def quantise(x: float) -> float:
        if n.resolution >= 1:
            return cast(math.floor(x / n.resolution + 0.5) * n.resolution)
        inverse = 1.0 / n.resolution
        return cast(math.floor(x * inverse + 0.5) / inverse)

    q = quantise(value)
    if q < n.minimum or q > n.maximum:
        return None
    w = cast(q - quantise(cast(n.minimum)))
    w = cast(w / n.resolution if n.resolution >= 1 else w * (1.0 / n.resolution))
    return math.floor(w + 0.5) + n.offset


@st.composite
def floats_with_bounds(draw: st.DrawFn) -> tuple[Numeric, float]:
    number_type = draw(st.sampled_from(["double", "float"]))
    resolution = draw(st.sampled_from([10.0**-k for k in range(-3, 10)] + [0.25, 0.3, 0.5, 2.0, 30.0, 7.5]))
    start = draw(st.integers(-(10**7), 10**7))
    count = draw(st.integers(0, 10**6))
    low, high = start * resolution, (start + count) * resolution
    numeric = make_numeric(number_type, low, high, resolution, draw(st.booleans()))
    value = draw(st.floats(low - 2 * resolution, high + 2 * resolution) | st.sampled_from([low, high]))
    return numeric, to_float32(value) if number_type == "float" else value


@given(floats_with_bounds())
@settings(max_examples=4 * settings().max_examples)
def test_an_affine_field_sends_its_index_less_its_origin(case: tuple[Numeric, float]) -> None:
    n, value = case
    expected = long_form(n, value)
    assert n.wire(value) == expected
    if not n.is_affine:
        return
    scaled = value / n.resolution if n.resolution >= 1 else value * n.inverse
    index = math.floor(scaled + 0.5)
    short = index - n.origin + n.offset if n.lowest <= index <= n.highest else None
    assert short == expected


@given(floats_with_bounds())
@settings(max_examples=2 * settings().max_examples)
def test_a_field_s_bounds_are_valid_on_the_wire_and_nothing_beyond_them(case: tuple[Numeric, float]) -> None:
    n, _ = case
    if not n.is_affine:
        return
    assert n.is_valid_wire(n.greatest_wire) and n.is_valid_wire(n.first - n.origin + n.offset)
    assert not n.is_valid_wire(n.greatest_wire + 1)


@given(floats_with_bounds(), st.data())
@settings(max_examples=2 * settings().max_examples)
def test_an_affine_field_decodes_to_its_index_times_the_resolution(
    case: tuple[Numeric, float], data: st.DataObject
) -> None:
    n, _ = case
    if not n.is_affine:
        return
    index = data.draw(st.integers(n.first, n.last))
    short = index * n.resolution if n.resolution >= 1 else index / n.inverse
    short = to_float32(short) if n.number_type == "float" else short
    assert n.value(index - n.origin + n.offset) == short


def test_most_fields_have_the_short_form() -> None:
    assert make_numeric("double", -180, 180, 1e-9, True).is_affine
    assert make_numeric("float", -4, 4, 1e-3, True).is_affine
    assert make_numeric("int32", -20, 3000, 1.0, True).is_affine
    # 24 bits of mantissa do not carry 30 bits of steps: this one takes the long way.
    assert not make_numeric("float", 0, 1e6, 1e-3, True).is_affine


def test_negative_integers_truncate_towards_zero_as_in_dccl() -> None:
    tens = make_numeric("int32", -1000, 1000, 10.0, True)
    assert [tens.value(tens.wire(v) or 0) for v in (-17, -10, 14, 15, 17)] == [-10, -10, 10, 20, 20]


def test_nan_is_the_minimum_of_the_library() -> None:
    assert make_numeric("double", -1, 1, 0.1, True).wire(math.nan) == 0
    assert make_numeric("double", -1, 1, 0.1, False).wire(math.nan) == 1

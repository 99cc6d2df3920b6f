"""The range coder and the bell: what goes in comes out, at the cost that its probability says."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st

from messages.entropy import NEAR, RangeDecoder, RangeEncoder, Spread

COUNTS = st.sampled_from([1, 2, 3, 1000, 2**40, 2**40 + 1, 2**53, 2**64])


@st.composite
def symbols(draw: st.DrawFn) -> list[tuple[int, int, int, int]]:
    """(scale or 0 for uniform, low, high, value)."""
    made = []
    for _ in range(draw(st.integers(0, 12))):
        if draw(st.booleans()):
            count = draw(COUNTS)
            made.append((0, 0, count - 1, draw(st.integers(0, count - 1))))
        else:
            low, high = (
                -draw(st.sampled_from([0, 1, 50, NEAR, 10**6])),
                draw(st.sampled_from([0, 1, 50, NEAR, 10**6])),
            )
            made.append(
                (draw(st.sampled_from([1, 16, 5000, 2**24])), low, high, draw(st.integers(low, high)))
            )
    return made


@given(symbols(), st.integers(0, 2**70), st.sampled_from([0, 1, 7, 70]))
def test_symbols_come_back_whatever_bits_follow(
    made: list[tuple[int, int, int, int]], more: int, extra: int
) -> None:
    encoder = RangeEncoder()
    for scale, low, high, value in made:
        if scale == 0 or not Spread(scale, low, high).encode(encoder, value):
            encoder.encode_uniform(value - low, high - low + 1)
    code, length = encoder.finish()
    decoder = RangeDecoder(code << extra | more & (1 << extra) - 1, length + extra)
    for scale, low, high, value in made:
        got = None if scale == 0 else Spread(scale, low, high).decode(decoder)
        assert (decoder.decode_uniform(high - low + 1) + low if got is None else got) == value
    assert decoder.taken_bits() == length


@given(st.binary(max_size=30), symbols())
def test_any_bits_decode_to_values_in_range(data: bytes, made: list[tuple[int, int, int, int]]) -> None:
    decoder = RangeDecoder(int.from_bytes(data, "big"), 8 * len(data))
    for scale, low, high, _ in made:
        if scale:
            got = Spread(scale, low, high).decode(decoder)
            assert got is None or low <= got <= high


def test_uniform_symbols_cost_their_logarithm() -> None:
    encoder = RangeEncoder()
    for i in range(1000):
        encoder.encode_uniform(i % 3, 3)
    assert 1000 * math.log2(3) <= encoder.finish()[1] <= 1000 * math.log2(3) + 2


def test_a_carry_runs_through_what_is_written() -> None:
    encoder = RangeEncoder()
    for _ in range(20):
        encoder.encode(2**16 - 1, 1, 2**16)  # digits of all ones ...
    encoder.encode(1, 1, 3)  # ... and an interval that may end beyond them
    code, length = encoder.finish()
    decoder = RangeDecoder(code, length)
    for _ in range(20):
        assert decoder.share(2**16) == 2**16 - 1
        decoder.take(2**16 - 1, 1)
    assert decoder.share(3) == 1


def test_a_residual_near_the_scale_is_cheap_and_a_far_one_is_possible() -> None:
    def bits(value: int) -> int:
        encoder = RangeEncoder()
        Spread(32, -1000, 1000).encode(encoder, value)
        return encoder.finish()[1]

    assert bits(0) <= 4
    assert bits(1000) <= 26
    assert [bits(v) for v in (0, 2, 8, 50)] == sorted(bits(v) for v in (0, 2, 8, 50))

"""The peer's delays tell of a link that has fallen without a silence."""

from __future__ import annotations

import random

from hypothesis import given
from hypothesis import strategies as st

from shaper.estimation.way_back import FILLS_NS, WayBack

MS = 1_000_000


def hear(way: WayBack, delays_ms: list[float], noise_ns: float = 0.0) -> list[int]:
    """Which of datagrams sent every 20 ms say that the way back fills."""
    told = []
    for index, delay_ms in enumerate(delays_ms):
        sent_us = 5_000_000 + index * 20_000
        now_ns = 77_000_000_000 + sent_us * 1000 + round(delay_ms * MS)  # another clock
        if way.fills(sent_us, noise_ns, now_ns):
            told.append(index)
    return told


def test_a_queue_that_grows_is_told_once_and_again_after_it_has_shrunk() -> None:
    grows = [300.0 + 45 * n for n in range(20)]
    assert hear(WayBack(), [300.0] * 5 + grows) == [10]
    assert len(hear(WayBack(), [*grows, 300.0, *grows])) == 2


def test_one_step_is_another_delay_and_no_queue() -> None:
    assert hear(WayBack(), [50.0] * 10 + [500.0] * 50) == []


def test_what_a_large_datagram_takes_longer_than_a_small_one_is_no_queue() -> None:
    assert hear(WayBack(), [500.0, 598.0, 548.0] * 40) == []
    assert hear(WayBack(), [500.0, 540.0, 580.0, 648.0] * 40) == []


@given(seed=st.integers(0, 1 << 32), jitter_ms=st.floats(0, 15))
def test_jitter_is_no_queue(seed: int, jitter_ms: float) -> None:
    rng = random.Random(seed)
    delays_ms = [100 + abs(rng.gauss(0, jitter_ms)) for _ in range(400)]
    assert hear(WayBack(), delays_ms, noise_ns=0.7 * jitter_ms * MS) == []


@given(slope=st.floats(0.3, 5))
def test_it_is_known_when_little_more_than_the_limit_has_gathered(slope: float) -> None:
    delays_ms = [100 + 20 * slope * n for n in range(200)]
    (told,) = hear(WayBack(), delays_ms)
    gathered_ns = 20 * slope * told * MS
    assert FILLS_NS < gathered_ns <= max(FILLS_NS, 3 * 20 * slope * MS) + 21 * slope * MS

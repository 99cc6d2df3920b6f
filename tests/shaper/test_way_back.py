"""The peer's delays tell of a link that has fallen without a silence."""

from __future__ import annotations

import random

from hypothesis import given
from hypothesis import strategies as st

from shaper.estimation.way_back import FILLS_NS, WayBack

MS = 1_000_000


def hear(
    way: WayBack, delays_ms: list[float], noise_ns: float = 0.0, promises_ms: list[float] | None = None
) -> list[int]:
    """Which of datagrams sent every 20 ms say that the way back fills."""
    told = []
    promises_ms = promises_ms or [20.0] * len(delays_ms)
    for index, (delay_ms, promise_ms) in enumerate(zip(delays_ms, promises_ms, strict=True)):
        sent_us = 5_000_000 + index * 20_000
        now_ns = 77_000_000_000 + sent_us * 1000 + round(delay_ms * MS)  # another clock
        if way.fills(sent_us, round(promise_ms * MS), noise_ns, now_ns):
            told.append(index)
    return told


def test_a_queue_that_grows_is_told_once_and_again_after_it_has_shrunk() -> None:
    grows = [300.0 + 45 * n for n in range(20)]
    assert hear(WayBack(), [300.0] * 5 + grows) == [8]
    assert len(hear(WayBack(), [*grows, 300.0, *grows])) == 2


def test_one_step_is_another_delay_and_no_queue() -> None:
    assert hear(WayBack(), [50.0] * 10 + [500.0] * 50) == []


def test_what_a_large_datagram_takes_longer_than_a_small_one_is_no_queue() -> None:
    for takes_ms in ([10.0, 98.0, 48.0], [10.0, 50.0, 90.0, 158.0]):
        delays_ms = [490 + ms for ms in takes_ms]
        assert hear(WayBack(), delays_ms * 40, promises_ms=takes_ms * 40) == []


def test_a_queue_is_seen_though_small_datagrams_come_between_large_ones() -> None:
    """The rate has halved: each takes twice what it promised, and the next one waits for it."""
    promises_ms = [50.0, 10.0] * 20
    delays_ms, queue_ms = [], 0.0
    for promise_ms in promises_ms:
        delays_ms.append(500 + queue_ms + 2 * promise_ms)
        queue_ms += promise_ms
    (told,) = hear(WayBack(), delays_ms, promises_ms=promises_ms)
    assert told <= 12


@given(seed=st.integers(0, 1 << 32), jitter_ms=st.floats(0, 15))
def test_jitter_is_no_queue(seed: int, jitter_ms: float) -> None:
    rng = random.Random(seed)
    delays_ms = [100 + abs(rng.gauss(0, jitter_ms)) for _ in range(400)]
    assert hear(WayBack(), delays_ms, noise_ns=0.7 * jitter_ms * MS) == []


def test_the_rise_itself_is_no_noise() -> None:
    """Each step of 10 ms raises what is taken for noise by 1 ms; that before the first one counts."""
    way, told = WayBack(), []
    for index in range(60):
        sent_us, late_ms = 5_000_000 + index * 20_000, 10 * max(0, index - 30)
        now_ns = sent_us * 1000 + (100 + late_ms) * MS
        if way.fills(sent_us, 20 * MS, late_ms * MS / 10, now_ns):
            told.append(index)
    assert told == [39]


@given(slope=st.floats(0.3, 5))
def test_it_is_known_when_little_more_than_the_limit_has_gathered(slope: float) -> None:
    delays_ms = [100 + 20 * slope * n for n in range(200)]
    (told,) = hear(WayBack(), delays_ms)
    gathered_ns = 20 * slope * told * MS
    assert FILLS_NS < gathered_ns <= max(FILLS_NS, 3 * 20 * slope * MS) + 21 * slope * MS

"""What the spacing of arrivals says of a link."""

from __future__ import annotations

from itertools import pairwise

import pytest

from shaper.estimation.dispersion import Dispersion
from shaper.estimation.flights import Flight

MS = 1_000_000


def arrivals(dispersion: Dispersion, first_ns: int, rate_bps: float, count: int = 4, number: int = 0) -> None:
    """A train of datagrams of 1,000 bits that leaves at once, and arrives as a link of this rate spreads it."""
    flights = []
    for index in range(count):
        flight = Flight(number + index, first_ns + index * 100_000, 1000, 0)
        flight.arrived_ns = first_ns + 50 * MS + round(index * 1000 * 1e9 / rate_bps)
        flights.append(flight)
    for first, second in pairwise(flights):
        dispersion.add(first, second, None)


def test_what_left_before_a_silence_was_seen_says_nothing_where_it_looks_like_the_former_link() -> None:
    dispersion = Dispersion()
    arrivals(dispersion, 10 * MS, 1e6)
    assert dispersion.of_trains(0, 0, 1e6) == pytest.approx(1e6, rel=0.01)
    assert dispersion.of_trains(0, 100 * MS, 1e6) is None


def test_it_counts_where_it_shows_another_rate_or_none_was_known() -> None:
    slow = Dispersion()
    arrivals(slow, 10 * MS, 1e5)
    assert slow.of_trains(0, 100 * MS, 1e6) == pytest.approx(1e5, rel=0.01)
    first = Dispersion()
    arrivals(first, 10 * MS, 1e6)
    assert first.of_trains(0, 100 * MS, None) == pytest.approx(1e6, rel=0.01)


def test_what_comes_in_a_clump_behind_a_delay_that_fell_is_no_rise() -> None:
    """The last of the old band arrives with what left 50 ms later, and the next one as if it were close."""
    dispersion = Dispersion()
    flights = []
    for number, (sent_ms, arrived_ms) in enumerate([(0, 300), (20, 300), (40, 300), (60, 301), (60, 313)]):
        flight = Flight(number, sent_ms * MS, 1200, 1)
        flight.arrived_ns = arrived_ms * MS
        flights.append(flight)
    for first, second in pairwise(flights):
        dispersion.add(first, second, 1e5)
    assert [pair.measurable for pair in dispersion._pairs] == [False, False, False, True]
    assert dispersion.risen(1e5) is None


def test_large_datagrams_behind_small_ones_on_an_idle_link_are_no_fall() -> None:
    """They are spread by their own size too; that they queued is what a sender with a wrong rate may think."""
    dispersion = Dispersion()
    now_ns = empty_ns = 0
    flights = []
    for number in range(12):
        large = number % 2 == 1
        size_bytes = 1200 if large else 60
        now_ns += 4 * MS if large else 20 * MS
        empty_ns = max(empty_ns, now_ns) + size_bytes * 8_000
        flight = Flight(number, now_ns, size_bytes * 8, 1)
        flight.arrived_ns = empty_ns + 50 * MS
        flights.append(flight)
    for first, second in pairwise(flights):
        dispersion.add(first, second, 1e6)
        assert dispersion.fallen(1e6) is None

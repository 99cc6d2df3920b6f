"""Falls that come at regular times are foreseen; what is not regular costs next to nothing."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shaper.estimation.predicting import SlowedPacer
from shaper.estimation.regular_falls import NEEDED, RegularFalls
from shaper.pacer import Pacer

MS = 1_000_000
S = 1_000_000_000
FAST, THIN = 1_000_000.0, 100_000.0


# What is learnt.


def learn(times_ns: list[int]) -> RegularFalls:
    falls = RegularFalls()
    for at_ns in times_ns:
        falls.on_fall(at_ns, FAST, THIN)
    return falls


def test_three_falls_evenly_spaced_foretell_the_fourth() -> None:
    expected = learn([60 * S, 180 * S, 300 * S + 20 * MS]).expected(0.97 * FAST)
    assert expected is not None
    assert expected.news_ns == 420 * S + 30 * MS
    assert (expected.from_bps, expected.to_bps, expected.spread_ns) == (FAST, THIN, 20 * MS)


@pytest.mark.parametrize("times_s", [[60], [60, 180], [60, 180, 299], [1, 3, 5], [60, 180, 420]])
def test_fewer_or_uneven_or_too_frequent_falls_foretell_nothing(times_s: list[int]) -> None:
    assert learn([at_s * S for at_s in times_s]).expected(FAST) is None


def test_a_fall_is_foretold_from_its_own_rate_only() -> None:
    falls = learn([60 * S, 180 * S, 300 * S])
    assert falls.expected(THIN) is None
    assert falls.expected(2 * FAST) is None


def test_two_kinds_of_falls_are_told_apart() -> None:
    falls = RegularFalls()
    for cycle in range(3):
        falls.on_fall((30 + 90 * cycle) * S, FAST, 300_000.0)
        falls.on_fall((60 + 90 * cycle + 7 * (cycle == 1)) * S, 300_000.0, THIN)
    first = falls.expected(FAST)
    assert first is not None and first.news_ns == 300 * S
    assert falls.expected(300_000.0) is None  # its second one was late


def test_a_fall_that_does_not_come_ends_the_rule() -> None:
    falls = learn([60 * S, 180 * S, 300 * S])
    expected = falls.expected(FAST)
    assert expected is not None
    falls.on_missed(expected)
    assert falls.expected(FAST) is None
    for fall in range(2 * NEEDED):
        assert falls.expected(FAST) is None
        falls.on_fall((540 + 120 * fall) * S, FAST, THIN)
    again = falls.expected(FAST)
    assert again is not None and again.news_ns == (540 + 120 * 2 * NEEDED) * S


@given(st.lists(st.tuples(st.integers(5_000, 60_000), st.booleans()), max_size=60))
def test_at_most_one_expectation_in_three_falls_is_ever_in_vain(dwells: list[tuple[int, bool]]) -> None:
    """Whatever the link does, each slowing in vain was paid for by three falls before it."""
    falls, now_ns, in_vain, seen = RegularFalls(), 0, 0, 0
    for dwell_ms, comes in dwells:
        now_ns += dwell_ms * MS
        expected = falls.expected(FAST)
        if expected is not None and expected.news_ns + expected.spread_ns + 60 * MS < now_ns:
            falls.on_missed(expected)
            in_vain += 1
        if comes:
            falls.on_fall(now_ns, FAST, THIN)
            seen += 1
    assert in_vain <= seen // NEEDED


# How it is slowed.


def test_the_pacer_is_slowed_for_its_time_only() -> None:
    inner = Pacer(1_000_000, 0)
    pacer = SlowedPacer(inner)
    pacer.slow(100_000, 10 * S, 11 * S)
    sent, now_ns = [], 9 * S
    while now_ns < 12 * S:
        if pacer.may_send(now_ns):
            pacer.on_sent(1250, now_ns)
            sent.append(now_ns)
        now_ns = max(pacer.next_send_at_ns(now_ns), now_ns + 1)
    counts = [sum(begin * S <= at_ns < (begin + 1) * S for at_ns in sent) for begin in (9, 10, 11)]
    assert counts[0] == pytest.approx(100, abs=1) and counts[2] == pytest.approx(100, abs=1)
    assert counts[1] in (10, 11)


def test_heartbeats_and_emergency_stops_are_not_slowed() -> None:
    pacer = SlowedPacer(Pacer(1_000_000, 0))
    pacer.slow(1000, 0, 10 * S)
    pacer.on_sent(1250, 0)
    assert pacer.next_send_at_ns(0) == 10 * S
    assert pacer.urgent_at_ns(0) == 10 * MS
    pacer.release()
    assert pacer.next_send_at_ns(0) == 10 * MS

"""The parts of the adaptive estimator, each by itself."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shaper.estimation.adaptive import AdaptiveEstimator
from shaper.estimation.bands import Bands
from shaper.estimation.baseline import PAUSE_NS, Baseline
from shaper.estimation.dispersion import Dispersion
from shaper.estimation.flights import Flight, Flights
from shaper.estimation.followed_rate import DRIFT_RATIO, FollowedRate
from shaper.estimation.silence import Silence
from shaper.estimation.standstill import Standstill
from shaper.estimation.states import TRANSITIONS, Input, State, follow, mermaid
from shaper.estimation.trains import Trains, probing_bps
from shaper.estimation.trickle import (
    LONGEST_TRICKLE_NS,
    TRICKLE_BYTES,
    TRICKLE_SHARE,
    trickle_ns,
    urgent_trickle_ns,
)
from shaper.estimation.virtual_queue import VirtualQueue
from shaper.link_estimator import PresetBand
from shaper.path import HeardPacket, SentPacket

MS = 1_000_000
S = 1_000_000_000
RATE_BPS = 1_000_000


def flight(number: int, sent_ns: int, arrived_ns: int, size: int = 1000, wait_ns: int = 1) -> Flight:
    made = Flight(number, sent_ns, size * 8, wait_ns)
    made.arrived_ns = arrived_ns
    return made


def stream(sent_every_ns: int, arrived_every_ns: int, count: int = 60) -> Dispersion:
    """Datagrams of 1000 bytes that left and arrived evenly."""
    dispersion = Dispersion()
    flights = [flight(n, n * sent_every_ns, S + n * arrived_every_ns) for n in range(count)]
    for first, second in pairwise(flights):
        dispersion.add(first, second, RATE_BPS)
    return dispersion


@given(st.sampled_from(State), st.sampled_from(Input))
def test_every_input_leads_to_a_state_that_is_drawn(state: State, happened: Input) -> None:
    after = follow(state, happened)
    assert after is TRANSITIONS.get((state, happened), state)
    assert (state, happened) not in TRANSITIONS or f"{state} --> {after}: {happened}" in mermaid()


@given(
    st.integers(5_000, 10_000_000),
    st.lists(st.tuples(st.integers(0, S), st.integers(40, 1500)), min_size=1, max_size=30),
)
def test_a_datagram_that_may_leave_finds_no_more_queue_than_is_allowed(
    rate_bps: int, sent: list[tuple[int, int]]
) -> None:
    queue, now_ns = VirtualQueue(rate_bps, 4 * MS, 0), 0
    for pause_ns, size in sent:
        now_ns = queue.next_send_at_ns(now_ns + pause_ns)
        assert queue.may_send(now_ns)
        queue.on_sent(size, now_ns)
        assert queue.found_ns <= 4 * MS
        served_ns = size * 8 * S // rate_bps
        assert served_ns <= queue.wait_ns(now_ns) <= served_ns + 4 * MS + 2


def test_what_must_always_pass_waits_neither_for_the_queue_nor_for_a_long_pause_but_for_a_short_one() -> None:
    queue = VirtualQueue(100_000, 4 * MS, 0)
    queue.on_sent(1200, 0)
    assert queue.next_send_at_ns(0) == 92 * MS and queue.urgent_at_ns(0) == 60 * MS
    queue.pause(400 * MS)
    assert queue.urgent_at_ns(0) == 60 * MS
    queue.pause(90 * MS)
    assert queue.urgent_at_ns(0) == 90 * MS


def test_arrivals_at_the_known_rate_tell_of_no_change() -> None:
    dispersion = stream(8 * MS, 8 * MS)
    assert dispersion.fallen(RATE_BPS) is None
    assert dispersion.risen(RATE_BPS) is None
    assert dispersion.average(RATE_BPS) == pytest.approx(RATE_BPS)


@pytest.mark.parametrize("true_bps", [100_000, 300_000, 700_000])
def test_spread_arrivals_tell_the_lower_rate(true_bps: int) -> None:
    assert stream(8 * MS, 8000 * S // true_bps).fallen(RATE_BPS) == pytest.approx(true_bps, rel=0.01)


def test_one_late_arrival_is_no_fall() -> None:
    dispersion = stream(8 * MS, 8 * MS)
    late = flight(60, 480 * MS, S + 480 * MS + 200 * MS)
    dispersion.add(flight(59, 472 * MS, S + 472 * MS), late, RATE_BPS)
    assert dispersion.fallen(RATE_BPS) is None


def test_a_train_tells_the_higher_rate_and_a_clump_nothing() -> None:
    assert stream(0, 1 * MS, count=3).risen(RATE_BPS) == pytest.approx(8_000_000, rel=0.02)
    assert stream(0, 0, count=3).risen(RATE_BPS) is None


def test_what_later_flights_met_follows_from_one_that_is_known() -> None:
    flights = Flights()
    for number in range(5):
        flights.on_sent(number, 8000, 0, number * MS)
    queue_ns = flights.simulate(RATE_BPS, flights.unreported[0], 20 * MS, 10 * MS)
    assert queue_ns == 20 * MS + 5 * 8 * MS - 10 * MS
    assert [f.wait_ns for f in flights.unreported] == [20 * MS, 27 * MS, 34 * MS, 41 * MS, 48 * MS]


def test_the_channels_own_datagrams_delay_what_leaves_after_them() -> None:
    flights = Flights()
    flights.on_sent(0, 8000, 0, 0)
    flights.on_sent(1, 8000, 0, 1 * MS, bits_before=10_000)
    assert flights.simulate(RATE_BPS, flights.unreported[0], 0, 1 * MS) == 8 * MS + 10 * MS + 8 * MS - 1 * MS
    assert flights.unreported[1].wait_ns == 8 * MS + 10 * MS - 1 * MS


def verified(baseline: Baseline, delay_ns: int, now_ns: int) -> None:
    """A pause, after which a datagram met an empty link."""
    baseline.begin(now_ns, delay_ns)
    met = flight(0, now_ns, now_ns + 8 * MS + delay_ns, wait_ns=0)
    assert baseline.on_arrived([met], RATE_BPS, 0.0, now_ns)


def test_a_delay_that_is_higher_by_far_is_believed_the_second_time() -> None:
    baseline = Baseline(0)
    verified(baseline, 50 * MS, 1 * S)
    assert not baseline.verified
    verified(baseline, 52 * MS, 2 * S)
    assert baseline.verified and baseline.delay_ns == 52 * MS
    verified(baseline, 80 * MS, 3 * S)
    assert baseline.delay_ns == 52 * MS and baseline.due_ns == 3 * S
    verified(baseline, 80 * MS, 4 * S)
    assert baseline.delay_ns == 80 * MS


def crossed(number: int, sent_ns: int, delay_ns: int) -> Flight:
    """A datagram that takes 10 ms to serve; its delay without that."""
    flight = Flight(number, sent_ns, RATE_BPS // 100, 0)
    flight.arrived_ns = sent_ns + 10 * MS + delay_ns
    return flight


def known(delay_ns: int) -> Baseline:
    baseline = Baseline(0)
    verified(baseline, delay_ns, 1 * S)
    return baseline


def test_a_delay_too_low_is_raised_by_what_came_after_the_link_had_run_empty() -> None:
    baseline = known(50 * MS)
    flights = [crossed(n, 2 * S + n * 30 * MS, 300 * MS) for n in range(4)]
    baseline.look_for_idle(reversed(flights[:3]), RATE_BPS, 0.0)
    assert baseline.delay_ns == 50 * MS  # twice may be chance
    baseline.look_for_idle(reversed(flights[2:]), RATE_BPS, 0.0)
    assert baseline.delay_ns == 300 * MS


@pytest.mark.parametrize(
    ("interval_ms", "rise_ms", "numbers_apart"),
    [(10, 0, 1), (20, 20, 1), (30, 0, 2)],
    ids=["a queue that stands", "a link that has become slower", "losses, which take their time too"],
)
def test_a_delay_is_not_raised_by(interval_ms: int, rise_ms: int, numbers_apart: int) -> None:
    baseline = known(50 * MS)
    flights = [
        crossed(n * numbers_apart, 2 * S + n * interval_ms * MS, (300 + n * rise_ms) * MS) for n in range(9)
    ]
    baseline.look_for_idle(reversed(flights), RATE_BPS, 0.0)
    assert baseline.delay_ns == 50 * MS


def test_what_leaves_in_a_pause_puts_its_end_off_but_not_for_ever() -> None:
    baseline = Baseline(0)
    baseline.begin(S + PAUSE_NS, 0)
    assert baseline.put_off(S + 30 * MS) == S + 30 * MS
    assert baseline.put_off(S + 20 * MS) == S + 30 * MS
    assert baseline.put_off(9 * S) == S + PAUSE_NS + 500 * MS


def test_a_lossy_way_back_must_miss_more_promises_before_it_is_silent() -> None:
    silence = Silence()
    assert [silence.needed_misses(loss) for loss in (0.0, 0.1, 0.2)] == [1, 4, 6]


def test_a_band_that_comes_back_is_recognised_and_another_is_not() -> None:
    bands = Bands()
    bands.settle(1e6, 100 * MS)
    fast = bands.current
    bands.leave()
    assert bands.current is None
    bands.settle(1e5, 1000 * MS)
    assert bands.current is not None and bands.current.name == "100 kbit/s 500 ms"
    bands.leave()
    bands.settle(0.98e6, 104 * MS)
    assert bands.current is fast
    bands.settle(1e6, 400 * MS)
    assert bands.current is not fast, "the same rate with another delay"


def test_a_rise_is_to_a_known_band_only_if_that_is_not_far() -> None:
    bands = Bands()
    bands.settle(1e6, 100 * MS)
    assert bands.likely(600_000, 120 * MS) == 1e6
    assert bands.likely(300_000, 120 * MS) == 300_000, "else trains of another band fill its buffer"
    assert bands.likely(600_000, 400 * MS) == 600_000


def test_trains_follow_each_other_at_a_tenth_of_the_last_rate() -> None:
    assert [probing_bps(rate_bps) for rate_bps in (1e6, 50_000, 5_000)] == [100_000, 8_000, 5_000]


def test_a_rate_that_drifts_far_either_way_is_in_doubt() -> None:
    followed = FollowedRate()
    followed.restart(1e6)
    assert followed.follow(1e6, 1.01e6) == (1.005e6, False)
    assert followed.follow(1.1e6, 1.6e6)[1]
    rate_bps, beyond = followed.follow(0.9e6, 0.6e6)
    assert beyond and rate_bps == pytest.approx(1e6 / DRIFT_RATIO, rel=0.01)


def test_trains_are_told_of_once_when_none_is_on_its_way() -> None:
    trains = Trains(0, hinted=False)
    assert not trains.are_all_reported(99)
    queue = VirtualQueue(100_000, 4 * MS, 0)
    trains.begin(queue)
    for number in (5, 6, 7):
        assert trains.on_sent(number, queue, 0)
    assert not trains.on_sent(8, queue, 0)
    assert [trains.are_all_reported(number) for number in (4, 6, 7, 8)] == [False, False, True, False]


def test_a_link_taken_for_what_it_was_gets_one_train_and_another_only_if_that_is_not_reported() -> None:
    trains, queue = Trains(0, hinted=True), VirtualQueue(100_000, 4 * MS, 0)
    trains.await_answer(100 * MS, 0)
    trains.begin(queue)
    trains.need_no_more()
    assert trains.next_at_ns(5 * MS) == 5 * MS, "of this one the rest is to leave"
    for number in range(3):
        trains.pace(trains.on_sent(number, queue, 0), 40 * MS, False, queue, 0)
    trains.pace(trains.on_sent(3, queue, 50 * MS), 90 * MS, False, queue, 50 * MS)
    assert trains.left == 0 and queue.not_before_ns == 0, "nothing is held back to keep trains whole"
    assert not trains.are_needed(1 * S) and trains.next_at_ns(60 * MS) > 1_200 * MS
    assert trains.are_needed(trains.next_at_ns(60 * MS))
    trains.stop(queue)
    assert trains.are_needed(1 * S)


@given(
    st.integers(10_000, 50_000_000), st.integers(2 * MS, 2 * S), st.integers(0, 3600 * S), st.integers(0, S)
)
def test_a_trickle_is_small_against_the_link_soon_and_ever_slower(
    rate_bps: int, rtt_ns: int, held_ns: int, later_ns: int
) -> None:
    interval_ns = trickle_ns(held_ns, rate_bps, rtt_ns)
    assert interval_ns <= trickle_ns(held_ns + later_ns, rate_bps, rtt_ns) <= LONGEST_TRICKLE_NS
    share = TRICKLE_BYTES * 8 * S / interval_ns / rate_bps
    assert share <= 1.001 * TRICKLE_SHARE or interval_ns == LONGEST_TRICKLE_NS
    assert interval_ns <= max(150 * MS, TRICKLE_BYTES * 8 * S / (TRICKLE_SHARE * rate_bps))
    if rate_bps > 2_000_000 and rtt_ns >= 20 * MS and held_ns < 30 * S:
        assert interval_ns <= 2 * rtt_ns, "the end of a blackout is noticed within two round trips"


def test_heartbeats_go_on_while_a_band_may_just_have_changed_and_become_rare_soon_after() -> None:
    def gap_ms(held_ms: int, rtt_ms: int) -> float:
        return urgent_trickle_ns(held_ms * MS, 100_000, rtt_ms * MS) / MS

    assert gap_ms(700, 100) < 100 and gap_ms(1_000, 1_000) <= 125
    assert gap_ms(2_000, 100) == 1_000 and gap_ms(2_000, 1_000) == 500
    assert gap_ms(30_000, 100) == 4 * trickle_ns(30 * S, 100_000, 100 * MS) / MS


def test_a_train_that_waits_for_room_lets_what_must_pass_go_before_it() -> None:
    queue = VirtualQueue(100_000, 4 * MS, 0)
    queue.not_before_ns = 9 * S
    queue.free, queue.free_from_ns = 3, 50 * MS
    assert queue.next_send_at_ns(0) == 50 * MS
    queue.on_sent(117, 20 * MS)
    assert queue.next_send_at_ns(20 * MS) == 50 * MS and queue.free == 3
    for _ in range(3):
        queue.on_sent(150, 50 * MS)
    assert queue.next_send_at_ns(50 * MS) == 9 * S


def test_nothing_is_probed_before_the_peer_is_heard() -> None:
    estimator = AdaptiveEstimator(now_ns=5 * S)
    assert estimator.probe_bytes(6 * S) == 0 and estimator.wakeup_at_ns() is None
    estimator.on_heard(HeardPacket(0, 123_456, 75, 1 * S), 7 * S)
    assert estimator.probe_bytes(7 * S) > 0 and estimator.confidence == 0.0


def test_trains_that_nobody_reports_become_rare() -> None:
    """Else what a faster band carried would fill the buffer of a slower one for as long as no word comes."""
    estimator = AdaptiveEstimator(bands=(PresetBand("fast", 10_000_000, 50 * MS),))
    estimator.on_heard(HeardPacket(0, 0, 75, 60 * S), 0)
    departures: list[int] = []
    now_ns = 0
    while now_ns < 20 * S:
        size_bytes = estimator.probe_bytes(now_ns)
        estimator.on_sent(SentPacket(len(departures), now_ns, size_bytes, ()), now_ns)
        estimator.pacer.on_sent(size_bytes, now_ns)
        departures.append(now_ns)
        now_ns = estimator.pacer.next_send_at_ns(now_ns + 1)
    assert sum(at_ns < S for at_ns in departures) > 60, "while an answer may come they are frequent"
    assert sum(at_ns > 10 * S for at_ns in departures) < 15


def test_the_documents_diagram_is_the_table() -> None:
    document = (Path(__file__).parents[2] / "docs" / "link_estimation.md").read_text()
    assert f"```mermaid\n{mermaid()}\n```" in document


def test_a_large_datagram_after_a_small_one_is_neither_missed_nor_late() -> None:
    """At 100 kbit/s one of 600 bytes takes 50 ms, a heartbeat 8; the heartbeat promises its own time."""
    silence = Silence()
    now_ns = 0
    for number in range(40):
        small = number % 5 == 4
        now_ns += 50 * MS if number % 5 else 8 * MS
        delay_ns = 500 * MS + (8 * MS if small else 50 * MS)
        late, _ = silence.on_heard(
            HeardPacket(number, (now_ns - delay_ns) // 1000, 75, 11 * MS if small else 53 * MS), now_ns
        )
        assert not late
        assert silence.deadline_ns > now_ns + 53 * MS


def test_sizes_of_datagrams_are_no_noise_of_the_path() -> None:
    """Else a thin way back would be taken to jitter, and its silence would be noticed late."""
    silence = Silence()
    now_ns = 0
    for number in range(200):
        small = number % 2 == 1
        now_ns += 50 * MS if number % 2 else 8 * MS
        delay_ns = 500 * MS + (8 * MS if small else 50 * MS)
        silence.on_heard(
            HeardPacket(number, (now_ns - delay_ns) // 1000, 75, 9 * MS if small else 52 * MS), now_ns
        )
    assert silence.noise_ns < 2 * MS
    assert silence.deadline_ns - now_ns < 9 * MS + 52 * MS + 10 * MS
    assert silence.same


def test_a_thin_link_whose_datagrams_are_mostly_small_is_not_silent_before_a_large_one() -> None:
    silence = Silence()
    now_ns = 0
    for number in range(200):
        large = number % 10 == 9
        now_ns += 175 * MS if large else 112 * MS
        assert now_ns <= silence.deadline_ns or number < 10
        size_ns = 175 * MS if large else 117 * MS
        silence.on_heard(HeardPacket(number, (now_ns - 50 * MS - size_ns) // 1000, 75, size_ns), now_ns)


def test_a_cautious_guess_slows_what_must_pass_no_more_than_the_last_rate_would() -> None:
    queue = VirtualQueue(100_000, 4 * MS, 0)
    queue.on_sent(117, 0)
    queue.set(10_000, 2_000 * MS, 0)
    assert queue.urgent_at_ns(0) > 300 * MS
    queue.set(10_000, 2_000 * MS, 0, urgent_bps=100_000)
    assert queue.urgent_at_ns(0) < 100 * MS


def heard_after(
    silence_ns: int, later_ns: int, rate_bps: int, told_bps: int, numbers: Iterable[int]
) -> list[bool]:
    """What a watcher says of each datagram of 125 bytes that comes after a silence, served at a rate."""
    standstill = Standstill()
    now_ns, said = 31 * S, []
    standstill.end(HeardPacket(6, 0, 125, peer_bps=told_bps), silence_ns, later_ns, 0.0, now_ns)
    for number in numbers:
        now_ns += 1000 * S // rate_bps
        said.append(standstill.is_as_before(HeardPacket(number, 0, 125, peer_bps=told_bps), now_ns))
    return said


@pytest.mark.parametrize(
    ("rate_bps", "as_before"), [(100_000, True), (90_000, True), (50_000, False), (1_000_000, False)]
)
def test_what_a_link_has_held_tells_whether_the_way_back_is_as_before(rate_bps: int, as_before: bool) -> None:
    said = heard_after(30 * S, 29 * S, rate_bps, 100_000, range(7, 47))
    assert said.count(True) == as_before


def test_only_while_what_was_held_may_tell_the_rate_no_train_has_to() -> None:
    standstill = Standstill()
    assert standstill.patience_ns == 0
    standstill.end(HeardPacket(6, 0, 125, peer_bps=1_000_000), 30 * S, 29 * S, 1e6, 31 * S)
    assert standstill.patience_ns == 2 * (20 + 10) * MS
    standstill.end(HeardPacket(6, 0, 125, peer_bps=1_000_000), 30 * S, 0, 1e6, 31 * S)
    assert standstill.patience_ns == 0, "the link has dropped what it held"


def test_that_is_known_after_six_datagrams_in_a_row_whatever_is_lost_between() -> None:
    assert heard_after(30 * S, 29 * S, 100_000, 100_000, [7, 8, 9, 11, 12, 14, 15, 16, 17]).index(True) == 7


@pytest.mark.parametrize(
    ("silence_ns", "later_ns", "told_bps"),
    [(30 * S, 5 * S, 100_000), (S // 2, S // 2, 100_000), (30 * S, 29 * S, 0)],
)
def test_a_queue_that_formed_in_a_short_silence_or_after_it_says_nothing_of_that(
    silence_ns: int, later_ns: int, told_bps: int
) -> None:
    assert not any(heard_after(silence_ns, later_ns, 100_000, told_bps, range(7, 47)))


def heard_by_size(
    silence: Silence, sizes: Iterable[int], delay_ns: int, told_bps: int, start_ns: int
) -> None:
    """A backlog of the peer's at 100 kbit/s: each datagram arrives when it has been served."""
    now_ns = start_ns
    for number, size_bytes in enumerate(sizes, silence._number + 1):
        served_ns = size_bytes * 80_000
        now_ns += served_ns
        sent_us = (now_ns - served_ns - delay_ns) // 1000
        silence.on_heard(HeardPacket(number, sent_us, size_bytes, served_ns + 3 * MS, told_bps), now_ns)


@pytest.mark.parametrize(("other_ns", "as_ever"), [(500 * MS, True), (900 * MS, False), (450 * MS, False)])
def test_a_small_datagram_after_a_blackout_took_as_long_as_the_large_ones_before_it_but_for_its_size(
    other_ns: int, as_ever: bool
) -> None:
    silence = Silence()
    heard_by_size(silence, [620] * 40, 500 * MS, 100_000, 0)
    heard_by_size(silence, [56], other_ns, 100_000, 40 * S)
    assert silence.as_ever is as_ever


def test_delays_that_a_wrongly_told_rate_made_look_short_are_forgotten() -> None:
    silence = Silence()
    heard_by_size(silence, [620] * 10, 500 * MS, 60_000, 0)
    heard_by_size(silence, [620] * 128, 500 * MS, 100_000, 10 * S)
    heard_by_size(silence, [56], 500 * MS, 100_000, 60 * S)
    assert silence.as_ever


@pytest.mark.parametrize(
    ("before", "other_ns", "quickened"),
    [(40, 450 * MS, True), (40, 490 * MS, False), (40, 550 * MS, False), (10, 450 * MS, False)],
)
def test_a_datagram_that_took_less_than_all_of_late_has_come_by_another_band(
    before: int, other_ns: int, quickened: bool
) -> None:
    silence = Silence()
    heard_by_size(silence, [620] * before, 500 * MS, 100_000, 0)
    heard_by_size(silence, [620], other_ns, 100_000, 40 * S)
    assert silence.quickened is quickened
    heard_by_size(silence, [620], other_ns, 100_000, 41 * S)
    assert not silence.quickened  # told once


@pytest.mark.parametrize(("fall_ms", "quickened"), [(100, True), (15, False)])
def test_where_the_order_is_kept_a_shorter_way_back_brings_a_clump_which_tells_the_same(
    fall_ms: int, quickened: bool
) -> None:
    """Of what was sent every 5 ms all that left in the new band comes behind the last of the old one."""
    silence, told = Silence(), []
    arrived_ms = 0
    for number in range(80):
        sent_ms = 5 * number
        delay_ms = 300 if number < 50 else 300 - fall_ms
        arrived_ms = max(arrived_ms, sent_ms + delay_ms)
        silence.on_heard(HeardPacket(number, sent_ms * 1000, 625, 5 * MS, 1_000_000), arrived_ms * MS)
        told.append(silence.quickened)
    assert told.count(True) == (1 if quickened else 0)
    assert not quickened or told.index(True) == 54, "the fifth of them took 25 ms less"


def test_a_queue_of_the_peers_that_drains_is_no_shorter_way_back() -> None:
    silence = Silence()
    for number in range(400):
        delay_us = 300_000 - 500 * max(0, number - 200)
        now_ns = 10 * number * MS + delay_us * 1000
        silence.on_heard(HeardPacket(number, 10_000 * number, 625, 10 * MS, 1_000_000), now_ns)
        assert not silence.quickened


def test_what_a_link_has_held_comes_ever_quicker_and_is_no_shorter_way_back() -> None:
    """30 s of a trickle, served one behind the other, and then what is sent anew."""
    silence = Silence()
    for number in range(40):
        silence.on_heard(
            HeardPacket(number, 10_000 * number, 625, 10 * MS, 1_000_000), (10 * number + 50) * MS
        )
    for number in range(40, 190):
        sent_ms = 400 + 200 * (number - 40)
        now_ns = (30_450 + 3 * (number - 40)) * MS
        silence.on_heard(HeardPacket(number, sent_ms * 1000, 54, 100 * MS, 1_000_000), now_ns)
        assert not silence.quickened

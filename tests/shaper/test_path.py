import random
from collections.abc import Collection
from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shaper.errors import DecodeError
from shaper.frames import ARRIVED_BITS, ReportFrame
from shaper.path import Path, PeerClock
from shaper.serial_number import expand

MS = 1_000_000
S = 1_000_000_000
PEER_OFFSET_NS = 5 * 3600 * S


def report(
    largest: int,
    at_ns: int,
    received: int,
    earlier: tuple[tuple[int, int], ...] = (),
    missing: Collection[int] = (),
) -> ReportFrame:
    """What a peer whose clock is PEER_OFFSET_NS ahead says; at_ns in our clock."""
    arrival_us = (at_ns + PEER_OFFSET_NS) // 1000
    bits = sum(1 << i for i in range(ARRIVED_BITS) if largest - 1 - i not in missing)
    arrived = bits.to_bytes(ARRIVED_BITS // 8, "little") if missing else b""
    return ReportFrame(1, largest & 0xFF_FFFF, arrival_us & 0xFFFF_FFFF, received, earlier, arrived)


@dataclass
class Fate:
    """What a datagram carried, and what the path said of it."""

    said: list[str]

    def on_arrived(self) -> None:
        self.said.append("arrived")

    def on_lost(self) -> None:
        self.said.append("lost")


def peer_us(at_ns: int) -> int:
    return (at_ns + PEER_OFFSET_NS) // 1000


def path_with(sent: int, wire_bytes: int = 1000) -> Path:
    """A path with packets sent at 0, 1, 2, ... ms."""
    path = Path()
    for i in range(sent):
        path.on_sent(wire_bytes, i * MS)
    return path


# What is in flight, what became of it.


def test_a_report_settles_all_up_to_the_newest_that_arrived() -> None:
    path = path_with(5)
    settled = path.on_report(report(3, 60 * MS, 3, ((2, 4_000),)), peer_us(60 * MS), PeerClock(), 110 * MS)

    assert [p.number for p in settled] == [0, 1, 2, 3]
    arrived_us = [p.arrival_us for p in settled]
    newest_us = peer_us(60 * MS) & 0xFFFF_FFFF
    assert arrived_us == [None, newest_us - 4_000, None, newest_us]
    assert path.bytes_in_flight == 1000


def test_a_report_that_says_nothing_new_settles_nothing() -> None:
    path, clock = path_with(5), PeerClock()
    path.on_report(report(3, 60 * MS, 4), peer_us(60 * MS), clock, 110 * MS)
    rtt_ns = path.rtt_ns
    assert path.on_report(report(3, 60 * MS, 4), peer_us(90 * MS), clock, 300 * MS) == []
    assert path.on_report(report(1, 20 * MS, 2), peer_us(30 * MS), clock, 300 * MS) == []
    assert path.rtt_ns == rtt_ns


@pytest.mark.parametrize("largest", [5, 6, 1 << 22])
def test_a_report_on_a_packet_that_was_never_sent_is_refused(largest: int) -> None:
    path = path_with(5)
    with pytest.raises(DecodeError, match="of 5 sent"):
        path.on_report(report(largest, 60 * MS, 4), peer_us(60 * MS), PeerClock(), 110 * MS)
    assert path.bytes_in_flight == 5000


def test_packet_numbers_go_on_across_their_wrap() -> None:
    path = Path()
    path.next_number = (1 << 24) - 2
    for i in range(4):
        path.on_sent(100, i * MS)
    path.on_report(report((1 << 24) - 1, 50 * MS, 2), peer_us(50 * MS), PeerClock(), 100 * MS)
    settled = path.on_report(report((1 << 24) + 1, 55 * MS, 4), peer_us(55 * MS), PeerClock(), 105 * MS)
    assert [p.number for p in settled] == [1 << 24, (1 << 24) + 1]


def test_a_restarted_peer_leaves_nothing_in_flight() -> None:
    path = path_with(5)
    path.on_peer_restarted()
    assert (path.bytes_in_flight, path.reported) == (0, False)
    path.on_sent(700, 10 * MS)
    assert path.bytes_in_flight == 700


@given(st.lists(st.tuples(st.integers(1, 1500), st.booleans()), min_size=1, max_size=50))
def test_what_is_in_flight_is_what_was_sent_after_the_newest_report(acts: list[tuple[int, bool]]) -> None:
    path, clock, sizes = Path(), PeerClock(), list[int]()
    reported = -1
    for i, (wire_bytes, is_reported) in enumerate(acts):
        path.on_sent(wire_bytes, i * MS)
        sizes.append(wire_bytes)
        if is_reported:
            path.on_report(report(i, i * MS, i + 1), peer_us(i * MS), clock, i * MS)
            reported = i
        assert path.bytes_in_flight == sum(sizes[reported + 1 :])


def test_a_heartbeat_into_hours_of_silence_is_remembered_in_bounded_memory() -> None:
    path = path_with(70_000, wire_bytes=73)
    assert len(path._in_flight) == 1 << 16
    assert path.bytes_in_flight == 73 << 16
    assert len(path.on_report(report(69_999, 0, 1), peer_us(0), PeerClock(), 70 * S)) == 1 << 16
    assert path.bytes_in_flight == 0


# Round trip.


def test_the_round_trip_leaves_out_the_time_that_the_peer_held_its_report() -> None:
    path = path_with(1)
    path.on_report(report(0, 50 * MS, 1), peer_us(250 * MS), PeerClock(), 310 * MS)
    assert path.rtt_ns == 110 * MS


def test_the_round_trip_is_right_when_the_stamps_wrap() -> None:
    path = path_with(1)
    arrival_us = (1 << 32) - 10_000
    path.on_report(ReportFrame(1, 0, arrival_us, 1), (1 << 32) + 40_000, PeerClock(), 150 * MS)
    assert path.rtt_ns == 100 * MS


# Loss.


def test_the_loss_ratio_follows_what_is_lost() -> None:
    generator = random.Random(1)
    path, clock, missing = Path(), PeerClock(), set[int]()
    for i in range(4000):
        path.on_sent(100, i * MS)
        if i % 10 == 9:
            path.on_report(report(i, i * MS, 0, missing=missing), peer_us(i * MS), clock, i * MS)
        elif generator.random() < 0.1:
            missing.add(i)
    assert path.loss_ratio == pytest.approx(0.1 * 0.9, abs=0.05)
    assert path.lost_packets == len(missing)


def test_what_is_lost_is_told_once_and_so_is_what_arrived() -> None:
    path, clock = Path(), PeerClock()
    fates = [Fate([]) for _ in range(8)]
    for i, fate in enumerate(fates):
        path.on_sent(100, i * MS, (fate,))
    for largest in (6, 7):
        path.on_report(report(largest, 60 * MS, 0, missing={1, 2}), peer_us(60 * MS), clock, 110 * MS)
    assert [fate.said for fate in fates] == [["lost"] if i in (1, 2) else ["arrived"] for i in range(8)]


def test_two_packets_may_overtake_one_before_it_is_taken_for_lost() -> None:
    path, clock, fate = Path(), PeerClock(), Fate([])
    for i in range(5):
        path.on_sent(100, i * MS, (fate,) if i == 1 else ())
    path.on_report(report(3, 50 * MS, 0, missing={1}), peer_us(50 * MS), clock, 100 * MS)
    assert fate.said == []
    path.on_report(report(4, 51 * MS, 0, missing={1}), peer_us(51 * MS), clock, 101 * MS)
    assert fate.said == ["lost"]


def test_one_that_was_overtaken_and_comes_has_arrived() -> None:
    path, clock, fate = Path(), PeerClock(), Fate([])
    for i in range(5):
        path.on_sent(100, i * MS, (fate,) if i == 1 else ())
    path.on_report(report(3, 50 * MS, 0, missing={1}), peer_us(50 * MS), clock, 100 * MS)
    path.on_report(report(4, 51 * MS, 0), peer_us(51 * MS), clock, 101 * MS)
    assert fate.said == ["arrived"]
    assert path.loss_ratio == 0


def test_one_that_was_only_late_is_no_loss_of_the_link() -> None:
    path, clock, fate = Path(), PeerClock(), Fate([])
    for i in range(6):
        path.on_sent(100, i * MS, (fate,) if i == 1 else ())
    path.on_report(report(0, 49 * MS, 0), peer_us(49 * MS), clock, 99 * MS)
    path.on_report(report(4, 50 * MS, 0, missing={1}), peer_us(50 * MS), clock, 100 * MS)
    assert path.loss_ratio > 0
    path.on_report(report(5, 51 * MS, 0), peer_us(51 * MS), clock, 101 * MS)
    assert (path.loss_ratio, path.lost_packets, path.lost_bytes) == (0, 0, 0)
    assert fate.said == ["lost"]  # it was repeated; so be it


def test_nine_eighths_of_a_round_trip_are_patience_enough_where_nothing_follows() -> None:
    path, clock, fate = Path(), PeerClock(), Fate([])
    for i in range(50):  # settle the round trip at 100 ms
        path.on_sent(100, i * MS)
        path.on_report(report(i, (i + 50) * MS, 0), peer_us((i + 50) * MS), clock, (i + 100) * MS)
    path.on_sent(100, 1000 * MS, (fate,))
    path.on_sent(100, 1001 * MS)
    path.on_report(report(51, 1051 * MS, 0, missing={50}), peer_us(1051 * MS), clock, 1101 * MS)
    assert fate.said == []
    path.on_sent(100, 1002 * MS)
    path.on_report(report(52, 1052 * MS, 0, missing={50}), peer_us(1080 * MS), clock, 1130 * MS)
    assert fate.said == ["lost"]


def test_a_lost_report_hides_nothing() -> None:
    """A later report says what has arrived of the last 64, so silence about packet 1 is no loss."""
    path, clock = Path(), PeerClock()
    fates = [Fate([]) for _ in range(60)]
    for i, fate in enumerate(fates):
        path.on_sent(100, i * MS, (fate,))
    path.on_report(report(59, 100 * MS, 0, missing={30}), peer_us(100 * MS), clock, 160 * MS)
    assert [i for i, fate in enumerate(fates) if fate.said == ["lost"]] == [30]


def test_the_first_report_of_a_peer_is_no_evidence_of_loss() -> None:
    """What left before it was there is repeated, but the link has lost nothing."""
    path, fate = Path(), Fate([])
    for i in range(100):
        path.on_sent(100, i * MS, (fate,) if i == 50 else ())
    path.on_report(report(99, 99 * MS, 1, missing=range(99)), peer_us(99 * MS), PeerClock(), 100 * MS)
    assert path.loss_ratio == 0
    assert fate.said == ["lost"]


@given(st.lists(st.tuples(st.integers(1, 300), st.binary(max_size=8)), max_size=40))
def test_the_loss_ratio_is_a_ratio_whatever_the_peer_claims(reports: list[tuple[int, bytes]]) -> None:
    path, clock = Path(), PeerClock()
    for sent, arrived in reports:
        for _ in range(sent):
            path.on_sent(100, 0)
        claim = report(path.next_number - 1, 0, 0)._replace(arrived=arrived)
        path.on_report(claim, peer_us(0), clock, 0)
        assert 0 <= path.loss_ratio <= 1


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 5), st.binary(max_size=8)), max_size=60))
def test_every_packet_has_one_fate_whatever_the_peer_claims(acts: list[tuple[bool, int, bytes]]) -> None:
    path, clock, fates = Path(), PeerClock(), list[Fate]()
    for now_ms, (is_report, back, arrived) in enumerate(acts):
        if not is_report or not fates:
            fates.append(Fate([]))
            path.on_sent(100, now_ms * MS, (fates[-1],))
            continue
        claim = report(max(0, len(fates) - 1 - back), now_ms * MS, 0)._replace(arrived=arrived)
        path.on_report(claim, peer_us(now_ms * MS), clock, now_ms * MS)
        assert all(len(fate.said) <= 1 for fate in fates)


# The peer's clock.


@given(
    offset_ns=st.integers(-(10**15), 10**15),
    one_way_ns=st.integers(0, 500 * MS),
    queueing_ns=st.lists(st.tuples(st.integers(0, 10 * S), st.integers(0, 10 * S)), min_size=1, max_size=20),
    drift_ppm=st.integers(-100, 100),
)
def test_the_offset_is_off_by_no_more_than_its_bound(
    offset_ns: int, one_way_ns: int, queueing_ns: list[tuple[int, int]], drift_ppm: int
) -> None:
    def peer_ns(now_ns: int) -> int:
        return now_ns + offset_ns + now_ns * drift_ppm // 1_000_000

    clock, now_ns = PeerClock(), 0
    best_ns = 1 << 62  # error bound of the best exchange, growing with the drift that is allowed for
    for there_ns, back_ns in queueing_ns:
        received_ns = now_ns + one_way_ns + there_ns
        back_at_ns = received_ns + 30 * MS + one_way_ns + back_ns
        clock.on_exchange(
            now_ns, peer_ns(received_ns) // 1000, peer_ns(received_ns + 30 * MS) // 1000, back_at_ns
        )
        elapsed_ns = back_at_ns - now_ns
        now_ns = back_at_ns
        best_ns = min(best_ns + elapsed_ns * 200 // 1_000_000, (elapsed_ns - 30 * MS) // 2)
        assert clock.offset_ns is not None
        error_ns = abs(clock.offset_ns - (peer_ns(now_ns) - now_ns))
        assert error_ns <= best_ns + elapsed_ns // 10_000 + 2_000


def test_one_sided_queueing_does_not_move_the_offset() -> None:
    clock = PeerClock()
    clock.on_exchange(0, peer_us(50 * MS), peer_us(50 * MS), 100 * MS)
    for i in range(1, 60):
        sent_ns = i * S
        queueing_ns = 2 * S
        clock.on_exchange(
            sent_ns,
            peer_us(sent_ns + 50 * MS + queueing_ns),
            peer_us(sent_ns + 50 * MS + queueing_ns),
            sent_ns + 100 * MS + queueing_ns,
        )
    assert clock.offset_ns == PEER_OFFSET_NS
    assert clock.delay_ns(peer_us(70 * S), 73 * S) == 3 * S


def test_a_drifting_clock_is_followed() -> None:
    clock = PeerClock()
    for i in range(3600):
        sent_ns = i * S
        drifted_ns = sent_ns + sent_ns // 10_000  # 100 ppm
        clock.on_exchange(
            sent_ns, peer_us(drifted_ns + 50 * MS), peer_us(drifted_ns + 50 * MS), sent_ns + 100 * MS
        )
    assert clock.offset_ns == pytest.approx(PEER_OFFSET_NS + 360 * MS, abs=1 * MS)


def test_without_an_exchange_no_delay_is_known() -> None:
    assert PeerClock().delay_ns(5, 6) is None


@given(st.integers(0, 0xFFFF_FFFF), st.lists(st.integers(0, 10**12), max_size=20))
def test_stamps_go_on_across_their_wrap(first_us: int, gaps_us: list[int]) -> None:
    clock, true_us = PeerClock(), first_us
    assert clock.expand_stamp(first_us, first_us * 1000) == first_us
    for gap_us in gaps_us:
        true_us += gap_us
        now_ns = true_us * 1000
        assert clock.expand_stamp(true_us & 0xFFFF_FFFF, now_ns) == true_us
        late_us = true_us - 1_000_000
        assert clock.expand_stamp(late_us & 0xFFFF_FFFF, now_ns) == late_us
    assert expand(true_us & 0xFFFF_FFFF, 32, true_us) == true_us

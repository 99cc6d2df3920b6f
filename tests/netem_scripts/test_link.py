"""The physics of one direction, each with figures that can be checked by hand."""

from __future__ import annotations

import random

import pytest

from netem_scripts.band import Band, DirectionProfile
from netem_scripts.link import DropReason, Link, LinkError, Passage

S = 1_000_000_000
MS = 1_000_000
PAYLOAD_BYTES = 1222  # 1250 bytes on the wire: 10 ms at 1 Mbit/s, 100 ms at 100 kbit/s


def link_of(*bands: Band, seed: int = 1, cyclic: bool = False, buffer_ns: int | None = None) -> Link:
    return Link(DirectionProfile(bands, cyclic=cyclic, buffer_ns=buffer_ns), random.Random(seed))


def fast(duration_s: float = 60, **faults: object) -> Band:
    return Band(round(duration_s * S), 1_000_000, 50 * MS, **faults)  # type: ignore[arg-type]


def slow(duration_s: float = 60) -> Band:
    return Band(round(duration_s * S), 100_000, 500 * MS)


def hold(duration_s: float) -> Band:
    return Band(round(duration_s * S), 0, 50 * MS)


def offer(link: Link, count: int, now_ns: int = 0) -> list[Passage]:
    return [link.transmit(PAYLOAD_BYTES, now_ns) for _ in range(count)]


def test_a_lone_packet_takes_its_serialisation_and_the_delay() -> None:
    passage = link_of(fast()).transmit(PAYLOAD_BYTES, 7)
    assert passage == Passage(1250, 0, 7 + 10 * MS, (7 + 60 * MS,), None)


def test_each_packet_waits_for_those_before_it() -> None:
    passages = offer(link_of(fast()), 3)
    assert [p.queue_delay_ns for p in passages] == [0, 10 * MS, 20 * MS]
    assert [p.arrivals_ns for p in passages] == [(60 * MS,), (70 * MS,), (80 * MS,)]


def test_an_idle_link_saves_no_credit() -> None:
    link = link_of(fast())
    assert [p.departure_ns for p in offer(link, 2, now_ns=30 * S)] == [30 * S + 10 * MS, 30 * S + 20 * MS]


def test_the_header_overhead_takes_capacity() -> None:
    link = Link(DirectionProfile((fast(),), overhead_bytes=0), random.Random(1))
    assert link.transmit(1250, 0).departure_ns == link_of(fast()).transmit(1222, 0).departure_ns == 10 * MS


def test_a_packet_in_the_middle_of_a_band_change_is_served_at_both_rates() -> None:
    passage = link_of(fast(1), slow()).transmit(PAYLOAD_BYTES, S - 4 * MS)
    assert passage.departure_ns == S + 60 * MS  # 4 ms for 4/10 of it, then 6/10 of 100 ms
    assert passage.arrivals_ns == (S + 560 * MS,)


def test_the_backlog_drains_at_the_new_rate() -> None:
    link = link_of(fast(1), slow())
    passages = offer(link, 10, now_ns=S - 50 * MS)
    assert link.backlog_bytes(S) == 5 * 1250
    assert passages[-1].departure_ns == S + 500 * MS
    assert link.backlog_bytes(S + 250 * MS) == 3125


def test_nothing_is_lost_of_the_backlog_when_the_new_rate_makes_it_longer_than_the_buffer() -> None:
    link = link_of(fast(1), slow(), buffer_ns=S)
    assert all(p.drop is None for p in offer(link, 100))  # 125 kB: 1 s at 1 Mbit/s
    link = link_of(fast(1), slow(), buffer_ns=S)
    last = offer(link, 100, now_ns=S - 1)[-1]
    assert last.drop is None and last.departure_ns is not None
    assert last.departure_ns // MS == 1000 + 9999  # 125 kB at 100 kbit/s, bar 1 ns of 1 Mbit/s
    assert link.transmit(PAYLOAD_BYTES, S).drop is DropReason.OVERFLOW


def test_the_delay_is_that_of_the_band_in_which_the_packet_leaves_the_queue() -> None:
    link = link_of(slow(1), fast())
    last = offer(link, 11)[-1]  # 10 leave in the slow second, the 11th 10 ms into the fast one
    assert last.departure_ns == S + 10 * MS


def test_a_packet_whose_last_bit_leaves_as_its_band_ends_has_that_band_s_delay() -> None:
    link = link_of(fast(1), Band(5 * MS, 1_000_000, 200 * MS), slow())
    assert link.transmit(PAYLOAD_BYTES, S - 5 * MS).arrivals_ns == (S + 205 * MS,)


def test_order_is_kept_again_after_a_band_that_reorders() -> None:
    link = link_of(slow(1), fast(0.01, reorder=True), fast())
    passages = offer(link, 12)  # 10 in the slow second, one in each of the others
    assert [p.arrivals_ns for p in passages[9:]] == [(1500 * MS,), (1060 * MS,), (1500 * MS,)]


def test_a_packet_waits_for_earlier_ones_when_the_delay_drops() -> None:
    passages = offer(link_of(slow(1), fast()), 11)
    assert passages[9].arrivals_ns == (1500 * MS,)
    assert passages[10].arrivals_ns == (1500 * MS,)  # not 1060 ms


def test_a_packet_overtakes_when_the_delay_drops_and_the_band_reorders() -> None:
    passages = offer(link_of(slow(1), fast(reorder=True)), 11)
    assert passages[10].arrivals_ns == (1060 * MS,)


def test_a_blackout_of_rate_0_holds_the_queue() -> None:
    link = link_of(fast(1), hold(5), fast())
    passages = offer(link, 2, now_ns=S - 10 * MS)
    assert [p.departure_ns for p in passages] == [S, 6 * S + 10 * MS]
    assert [p.queue_delay_ns for p in passages] == [0, 5 * S + 10 * MS]
    assert link.backlog_bytes(5 * S) == 1250


def test_a_packet_that_enters_an_empty_link_in_a_blackout_waits_for_its_end() -> None:
    link = link_of(fast(1), hold(5), fast())
    assert link.transmit(PAYLOAD_BYTES, 2 * S) == Passage(
        1250, 4 * S, 6 * S + 10 * MS, (6 * S + 60 * MS,), None
    )


def test_a_packet_cut_by_a_blackout_is_finished_after_it() -> None:
    assert (
        link_of(fast(1), hold(5), fast()).transmit(PAYLOAD_BYTES, S - 4 * MS).departure_ns == 6 * S + 6 * MS
    )


def test_a_buffer_in_seconds_keeps_the_rate_before_the_blackout() -> None:
    link = link_of(fast(1), hold(5), slow(), buffer_ns=100 * MS)
    assert [p.drop for p in offer(link, 11, now_ns=2 * S)] == [None] * 10 + [DropReason.OVERFLOW]


def test_a_buffer_in_seconds_keeps_the_rate_of_the_last_cycle_in_a_blackout_at_its_start() -> None:
    for now_ns in (0, 7 * S):
        link = link_of(hold(5), fast(1), slow(1), cyclic=True, buffer_ns=200 * MS)
        assert sum(p.drop is None for p in offer(link, 30, now_ns)) == 2  # of the 100 kbit/s before it


def test_a_buffer_in_seconds_holds_fewer_bytes_at_a_lower_rate() -> None:
    link = link_of(fast(1), slow(), buffer_ns=200 * MS)
    assert sum(p.drop is None for p in offer(link, 30)) == 20
    assert sum(p.drop is None for p in offer(link, 30, now_ns=S)) == 2


def test_a_packet_is_in_transit_until_the_instant_of_its_arrival() -> None:
    link = link_of(fast())
    offer(link, 1)
    before, at = link.totals(60 * MS - 1), link.totals(60 * MS)
    assert (before.in_transit, before.delivered, at.in_transit, at.delivered) == (1, 0, 0, 1)


def test_a_blackout_of_full_loss_drops_and_takes_capacity() -> None:
    link = link_of(fast(1, loss_ratio=1.0), fast())
    lost = offer(link, 100)
    assert {p.drop for p in lost} == {DropReason.LOSS} and all(p.arrivals_ns == () for p in lost)
    assert offer(link, 1)[0].departure_ns == S + 10 * MS


def test_a_full_buffer_drops_the_newcomer_and_serves_the_rest() -> None:
    link = link_of(fast(), buffer_ns=30 * MS)
    passages = offer(link, 5)
    assert [p.drop for p in passages] == [None] * 3 + [DropReason.OVERFLOW] * 2
    assert passages[4] == Passage(1250, 30 * MS, None, (), DropReason.OVERFLOW)
    assert link.transmit(PAYLOAD_BYTES, 10 * MS).departure_ns == 40 * MS


def test_the_stricter_of_two_buffers_holds() -> None:
    for buffer_ns, buffer_bytes, accepted in ((30 * MS, 10_000, 3), (S, 2500, 2), (None, 1250, 1)):
        direction = DirectionProfile((fast(),), buffer_ns=buffer_ns, buffer_bytes=buffer_bytes)
        passages = offer(Link(direction, random.Random(1)), 10)
        assert sum(p.drop is None for p in passages) == accepted


def test_a_duplicate_arrives_twice_and_takes_no_capacity() -> None:
    passages = offer(link_of(fast(duplicate_ratio=1.0)), 2)
    assert [p.arrivals_ns for p in passages] == [(60 * MS, 60 * MS), (70 * MS, 70 * MS)]


def test_served_bits_and_capacity_agree_on_a_saturated_link() -> None:
    link = link_of(fast(1), slow(1), cyclic=True)
    offer(link, 1000)
    for now_ns in (0, S // 3, S, S + 1, 2 * S, 5 * S + 123_456_789):
        assert link.served_bits(now_ns) == link.capacity_bits(0, now_ns)


def test_capacity_of_adjoining_intervals_adds_up() -> None:
    link = link_of(fast(1), slow(1), cyclic=True)
    whole = link.capacity_bits(0, 10 * S)
    assert whole == 5_500_000
    assert link.capacity_bits(0, 777_777_777) + link.capacity_bits(777_777_777, 10 * S) == whole


def test_the_bands_repeat_only_if_the_profile_is_cyclic() -> None:
    cyclic, once = link_of(fast(1), slow(1), cyclic=True), link_of(fast(1), slow(1))
    assert [cyclic.band_at(k * S).rate_bps for k in range(4)] == [1_000_000, 100_000] * 2
    assert [once.band_at(k * S).rate_bps for k in range(4)] == [1_000_000] + [100_000] * 3
    assert cyclic.next_change_ns(3 * S) == 4 * S
    assert once.next_change_ns(0) == S and once.next_change_ns(S) is None


def test_time_may_not_go_backwards() -> None:
    link = link_of(fast())
    link.transmit(1, 5)
    with pytest.raises(LinkError, match="now_ns = 4 must not be before the last one, 5"):
        link.transmit(1, 4)

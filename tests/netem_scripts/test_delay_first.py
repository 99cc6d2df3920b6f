"""The order delay-then-rate, and buffers and sizes counted in packets."""

from __future__ import annotations

import random
from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from netem_scripts.band import Band, DirectionProfile, Order
from netem_scripts.delay_first import Promises
from netem_scripts.link import DropReason, Link, Passage

S = 1_000_000_000
MS = 1_000_000
PAYLOAD_BYTES = 1222  # 1250 bytes on the wire: 10 ms at 1 Mbit/s, 100 ms at 100 kbit/s
FAST = Band(60 * S, 1_000_000, 50 * MS)
DELAY_FIRST = DirectionProfile((FAST,), order=Order.DELAY_THEN_RATE)


def link_of(direction: DirectionProfile) -> Link:
    return Link(direction, random.Random(1))


def offer(direction: DirectionProfile, count: int, now_ns: int = 0) -> list[Passage]:
    link = link_of(direction)
    return [link.transmit(PAYLOAD_BYTES, now_ns) for _ in range(count)]


def test_a_packet_is_delayed_then_served() -> None:
    first, second = offer(DELAY_FIRST, 2)
    assert first == Passage(1250, 0, 60 * MS, (60 * MS,), None)
    assert second == Passage(1250, 10 * MS, 70 * MS, (70 * MS,), None)


@given(
    st.integers(1_000, 10_000_000),
    st.integers(0, S),
    st.lists(st.tuples(st.integers(0, 1400), st.integers(0, S)), min_size=1, max_size=40),
)
def test_both_orders_agree_while_nothing_changes(
    rate_bps: int, delay_ns: int, offered: list[tuple[int, int]]
) -> None:
    direction = DirectionProfile((Band(S, rate_bps, delay_ns),))
    links = [link_of(direction), link_of(replace(direction, order=Order.DELAY_THEN_RATE))]
    now_ns = 0
    for size, gap_ns in offered:
        now_ns += gap_ns
        one, other = (link.transmit(size, now_ns) for link in links)
        # Each order rounds the departure up to a nanosecond, in its own place.
        assert abs(one.arrivals_ns[0] - other.arrivals_ns[0]) <= 1
        assert abs(one.queue_delay_ns - other.queue_delay_ns) <= 1


def test_what_is_in_the_delay_line_meets_the_rate_of_its_arrival_at_the_queue() -> None:
    bands = (Band(S, 1_000_000, 500 * MS), Band(S, 100_000, 500 * MS))
    delay_first = DirectionProfile(bands, order=Order.DELAY_THEN_RATE)
    assert offer(delay_first, 1, 600 * MS)[0].arrivals_ns == (
        1_200 * MS,
    )  # comes at 1.1 s: 100 ms of service
    assert offer(replace(delay_first, order=Order.RATE_THEN_DELAY), 1, 600 * MS)[0].arrivals_ns == (
        1_110 * MS,
    )


def at_a_delay_drop(reorder: bool) -> tuple[Link, list[Passage]]:
    """One packet 10 ms before the delay drops from 500 to 50 ms, two right after."""
    bands = (Band(S, 1_000_000, 500 * MS), replace(FAST, reorder=reorder))
    link = link_of(DirectionProfile(bands, order=Order.DELAY_THEN_RATE))
    return link, [link.transmit(PAYLOAD_BYTES, at_ns) for at_ns in (990 * MS, S, S)]


def test_a_packet_waits_for_earlier_ones_when_the_delay_drops() -> None:
    _, passages = at_a_delay_drop(reorder=False)
    assert [p.arrivals_ns for p in passages] == [(1_500 * MS,), (1_510 * MS,), (1_520 * MS,)]


def test_a_packet_overtakes_in_the_delay_line_and_is_served_first_when_it_may() -> None:
    link, passages = at_a_delay_drop(reorder=True)
    assert [p.arrivals_ns for p in passages] == [(1_500 * MS,), (1_060 * MS,), (1_070 * MS,)]
    assert link.backlog_bytes(S) == 0 and link.backlog_bytes(1_055 * MS) == 1250 + 625
    assert link.served_bits(1_495 * MS) == 2 * 10_000 + 5_000


def test_service_flows_around_what_is_promised_to_a_packet_from_further_away() -> None:
    bands = (Band(S, 1_000_000, 100 * MS), replace(FAST, reorder=True))
    link = link_of(DirectionProfile(bands, order=Order.DELAY_THEN_RATE))
    far = link.transmit(PAYLOAD_BYTES, S - 40 * MS)  # served from 1060 to 1070 ms
    near = [link.transmit(PAYLOAD_BYTES, S + 5 * MS) for _ in range(2)]  # at the queue from 1055 ms on
    assert far.arrivals_ns == (1_070 * MS,)
    assert [p.arrivals_ns for p in near] == [(1_075 * MS,), (1_085 * MS,)]
    assert [p.queue_delay_ns for p in near] == [0, 20 * MS]


def test_a_lost_packet_takes_no_capacity_and_a_copy_does() -> None:
    lossy = replace(DELAY_FIRST, bands=(Band(S, 1_000_000, 0, loss_ratio=1.0), Band(S, 1_000_000, 0)))
    link = link_of(lossy)
    assert link.transmit(PAYLOAD_BYTES, 0) == Passage(1250, 0, None, (), DropReason.LOSS)
    assert link.served_bits(S) == 0
    copied = replace(DELAY_FIRST, bands=(replace(FAST, duplicate_ratio=1.0),))
    assert offer(copied, 1)[0].arrivals_ns == (60 * MS, 70 * MS)


def test_a_copy_that_does_not_fit_is_an_overflow_and_the_packet_arrives() -> None:
    direction = replace(DELAY_FIRST, bands=(replace(FAST, duplicate_ratio=1.0),), buffer_packets=1)
    link = link_of(direction)
    assert link.transmit(PAYLOAD_BYTES, 0) == Passage(1250, 0, 60 * MS, (60 * MS,), None)
    totals = link.totals(S)
    assert (totals.offered, totals.duplicated, totals.overflowed, totals.delivered) == (1, 1, 1, 1)


def test_every_buffer_holds_as_many_behind_the_delay_as_before_it() -> None:
    for limit in ({"buffer_ns": 30 * MS}, {"buffer_bytes": 3750}, {"buffer_packets": 3}):
        for order in Order:
            direction = DirectionProfile((FAST,), order=order, **limit)
            drops = [p.drop for p in offer(direction, 5)]
            assert drops == [None] * 3 + [DropReason.OVERFLOW] * 2, (limit, order)


def test_a_buffer_in_packets_counts_the_one_in_service_until_its_last_bit() -> None:
    link = link_of(DirectionProfile((FAST,), buffer_packets=2))
    link.transmit(PAYLOAD_BYTES, 0), link.transmit(10, 0)
    full = link.transmit(10, 10 * MS - 1)
    assert full == Passage(38, 304_001, None, (), DropReason.OVERFLOW)
    assert link.transmit(10, 10 * MS).drop is None


def test_a_packet_above_the_mtu_is_dropped_at_its_entry() -> None:
    link = link_of(DirectionProfile((FAST,), mtu_bytes=1250))
    assert link.transmit(PAYLOAD_BYTES + 1, 0) == Passage(1251, 0, None, (), DropReason.OVERSIZE)
    assert link.transmit(PAYLOAD_BYTES, 0).departure_ns == 10 * MS
    assert link.totals(S).oversized == 1


def test_a_small_packet_costs_the_minimum() -> None:
    link = link_of(DirectionProfile((Band(S, 9_600, 0),), overhead_bytes=42, minimum_bytes=74))
    assert [link.transmit(size, 0).wire_bytes for size in (0, 32, 33)] == [74, 74, 75]


@given(st.lists(st.tuples(st.integers(0, 50), st.integers(1, 20)), max_size=30))
def test_promises_never_overlap_and_waste_no_gap(asked: list[tuple[int, int]]) -> None:
    """Against a slow allotment of one unit at a time."""
    promises, taken = Promises(), set[int]()
    for earliest, amount in asked:
        units: list[int] = []
        at = earliest
        while len(units) < amount:
            if at not in taken:
                units.append(at)
            at += 1
        first, end = promises.find(earliest, amount)
        assert (first, end) == (units[0], units[-1] + 1)
        promises.take(first, end)
        taken.update(units)
        assert promises.after(0) == len(taken)
    assert promises.after(17) == sum(unit >= 17 for unit in taken)

"""What holds for every link and every traffic."""

from __future__ import annotations

import math
import random
from bisect import bisect_right
from dataclasses import replace
from fractions import Fraction
from itertools import accumulate, pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem_scripts.band import Band, BurstLoss, DirectionProfile, JitterShape, Order
from netem_scripts.link import DropReason, Link, Passage

S = 1_000_000_000
MS = 1_000_000

rates_bps = st.one_of(st.just(0), st.integers(100, 5_000_000), st.sampled_from([9_600, 100_000, 1_000_000]))
ratios = st.sampled_from([0.0, 0.0, 0.1, 0.5, 1.0])


@st.composite
def bands(draw: st.DrawFn, faulty: bool) -> Band:
    loss_ratio = draw(ratios) if faulty else 0.0
    bursty = faulty and not loss_ratio and draw(st.booleans())
    return Band(
        duration_ns=draw(st.integers(20 * MS, 3 * S)),
        rate_bps=draw(rates_bps),
        one_way_delay_ns=draw(st.integers(0, S)),
        loss_ratio=loss_ratio,
        burst_loss=BurstLoss(0.2, 0.5) if bursty else None,
        corrupt_ratio=draw(ratios) if faulty else 0.0,
        jitter_ns=draw(st.sampled_from([0, 0, 10 * MS])) if faulty else 0,
        jitter_shape=draw(st.sampled_from(JitterShape)),
        duplicate_ratio=draw(ratios) if faulty else 0.0,
        reorder=draw(st.booleans()) if faulty else False,
    )


@st.composite
def directions(draw: st.DrawFn, faulty: bool = False, buffered: bool = True) -> DirectionProfile:
    chain = draw(st.lists(bands(faulty), min_size=1, max_size=5))
    chain.append(Band(draw(st.integers(1, S)), draw(st.integers(1_000, 1_000_000)), draw(st.integers(0, S))))
    return DirectionProfile(
        tuple(chain),
        cyclic=draw(st.booleans()),
        buffer_ns=draw(st.none() | st.integers(MS, 2 * S)) if buffered else None,
        buffer_bytes=draw(st.none() | st.integers(500, 20_000)) if buffered else None,
    )


@st.composite
def directions_of_any_kind(draw: st.DrawFn) -> DirectionProfile:
    return replace(
        draw(directions(faulty=True)),
        order=draw(st.sampled_from(Order)),
        buffer_packets=draw(st.none() | st.integers(1, 20)),
        minimum_bytes=draw(st.sampled_from([0, 74])),
        mtu_bytes=draw(st.none() | st.integers(500, 1500)),
    )


gaps_ns = st.sampled_from([0, 0, 1, 5 * MS]) | st.integers(0, 2 * S)
traffic = st.lists(st.tuples(st.integers(0, 1400), gaps_ns), min_size=1, max_size=40)


def carry(
    direction: DirectionProfile, offered: list[tuple[int, int]], seed: int = 1
) -> list[tuple[int, Passage]]:
    """Each packet's entry and fate; offered holds payload bytes and the gap before."""
    link = Link(direction, random.Random(seed))
    entries_ns = accumulate(gap_ns for _, gap_ns in offered)
    return [
        (now_ns, link.transmit(size, now_ns)) for (size, _), now_ns in zip(offered, entries_ns, strict=True)
    ]


def fluid_departure_ns(
    direction: DirectionProfile, free_at: Fraction, now_ns: int, wire_bytes: int
) -> Fraction:
    """The same server in rational numbers, walked band by band: slow, obvious, and written on its own."""
    at = max(free_at, Fraction(now_ns))
    left_bits = Fraction(8 * wire_bytes)
    index = 0
    cycle_ns = sum(band.duration_ns for band in direction.bands)
    cycle_bits = Fraction(sum(band.duration_ns * band.rate_bps for band in direction.bands), S)
    start_ns = at // cycle_ns * cycle_ns if direction.cyclic else 0
    while True:
        if direction.cyclic and at == start_ns and index % len(direction.bands) == 0:
            whole_cycles = max(0, math.ceil(left_bits / cycle_bits) - 1)  # the last one is walked
            left_bits -= whole_cycles * cycle_bits
            start_ns += whole_cycles * cycle_ns
            at = Fraction(start_ns)
        band = direction.bands[index % len(direction.bands)]
        last = not direction.cyclic and index == len(direction.bands) - 1
        end_ns = start_ns + band.duration_ns
        if at < end_ns or last:
            possible_bits = (end_ns - at) * band.rate_bps / S
            if band.rate_bps and (possible_bits >= left_bits or last):
                return at + left_bits * S / band.rate_bps
            left_bits -= possible_bits
            at = Fraction(end_ns)
        start_ns, index = end_ns, index + 1


@given(directions(buffered=False), traffic)
def test_departures_match_a_fluid_server(direction: DirectionProfile, offered: list[tuple[int, int]]) -> None:
    free_at = Fraction(0)
    for now_ns, passage in carry(direction, offered):
        free_at = fluid_departure_ns(direction, free_at, now_ns, passage.wire_bytes)
        assert passage.departure_ns == math.ceil(free_at)


@given(directions(), traffic)
def test_the_queue_delay_ends_when_the_first_bit_moves(
    direction: DirectionProfile, offered: list[tuple[int, int]]
) -> None:
    link = Link(direction, random.Random(1))
    previous_departure_ns = 0
    for now_ns, passage in carry(direction, offered):
        start_ns = now_ns + passage.queue_delay_ns
        assert start_ns >= max(now_ns, previous_departure_ns)
        # The packet before has left somewhere in the nanosecond that ends at start_ns, and so the rate of that
        # nanosecond counts too, should it be the last of its band.
        assert link.band_at(start_ns).rate_bps or link.band_at(max(0, start_ns - 1)).rate_bps
        # Nothing could be served between what was before it and its start; 1, since whole bits are counted.
        assert link.capacity_bits(max(now_ns, previous_departure_ns), start_ns) <= 1
        previous_departure_ns = passage.departure_ns or previous_departure_ns


@given(directions_of_any_kind(), traffic)
def test_the_rate_is_never_exceeded_over_any_interval(
    direction: DirectionProfile, offered: list[tuple[int, int]]
) -> None:
    link = Link(direction, random.Random(1))
    served: list[tuple[int, int]] = []
    for _, passage in carry(direction, offered):
        if passage.departure_ns is not None:  # in the order delay-then-rate each copy is served
            first = direction.order is Order.DELAY_THEN_RATE
            departures_ns = passage.arrivals_ns if first else (passage.departure_ns,)
            served += [(departure_ns, passage.wire_bytes) for departure_ns in departures_ns]
    served.sort()
    overtaken = direction.order is Order.DELAY_THEN_RATE and any(band.reorder for band in direction.bands)
    if overtaken:  # a packet may be served on both sides of another: only the sum since the start is bounded
        served = [(0, 0), *served]
    for first in range(1 if overtaken else len(served)):
        bits = 0
        for departure_ns, wire_bytes in served[first + 1 :]:
            bits += 8 * wire_bytes
            # From 1 ns before, since a departure is rounded up; + 1, since capacity counts whole bits.
            assert bits <= link.capacity_bits(max(0, served[first][0] - 1), departure_ns) + 1


@given(directions_of_any_kind(), traffic, st.integers(0, 5 * S))
def test_every_packet_is_accounted_for(
    direction: DirectionProfile, offered: list[tuple[int, int]], later_ns: int
) -> None:
    link = Link(direction, random.Random(3))
    now_ns, passages = 0, []
    for size, gap_ns in offered:
        now_ns += gap_ns
        passages.append(link.transmit(size, now_ns))
    now_ns += later_ns
    totals = link.totals(now_ns)
    arrivals_ns = [at for passage in passages for at in passage.arrivals_ns]
    assert totals.offered == len(offered)
    if direction.order is Order.RATE_THEN_DELAY:  # else copies overflow each for itself
        assert totals.overflowed == sum(p.drop is DropReason.OVERFLOW for p in passages)
        assert totals.duplicated == sum(len(p.arrivals_ns) == 2 for p in passages)
    assert totals.lost == sum(p.drop is DropReason.LOSS for p in passages)
    assert totals.oversized == sum(p.drop is DropReason.OVERSIZE for p in passages)
    assert totals.delivered == sum(at <= now_ns for at in arrivals_ns)
    assert totals.in_transit == sum(at > now_ns for at in arrivals_ns)
    accounted = totals.oversized + totals.overflowed + totals.lost + totals.delivered + totals.in_transit
    assert totals.offered + totals.duplicated == accounted


@given(directions_of_any_kind(), traffic)
def test_served_and_queued_bytes_are_all_that_was_accepted(
    direction: DirectionProfile, offered: list[tuple[int, int]]
) -> None:
    link = Link(direction, random.Random(3))
    now_ns = accepted_bytes = 0
    for size, gap_ns in offered:
        now_ns += gap_ns
        passage = link.transmit(size, now_ns)
        copies = len(passage.arrivals_ns) if direction.order is Order.DELAY_THEN_RATE else 1
        accepted_bytes += passage.wire_bytes * copies if passage.departure_ns is not None else 0
        served_bits, backlog_bytes = link.served_bits(now_ns), link.backlog_bytes(now_ns)
        unserved_bits = 8 * accepted_bytes - served_bits
        if direction.order is Order.RATE_THEN_DELAY:
            assert -1 <= unserved_bits - 8 * backlog_bytes + 8 <= 8 + 1
        else:  # the rest is in the delay line
            assert 0 <= 8 * backlog_bytes <= unserved_bits + 8
        assert served_bits <= link.capacity_bits(0, now_ns)


@given(directions(buffered=True), traffic)
def test_the_backlog_never_exceeds_the_buffer_in_bytes(
    direction: DirectionProfile, offered: list[tuple[int, int]]
) -> None:
    link = Link(direction, random.Random(3))
    now_ns = 0
    for size, gap_ns in offered:
        now_ns += gap_ns
        before_bytes = link.backlog_bytes(now_ns)
        passage = link.transmit(size, now_ns)
        if direction.buffer_bytes is not None:
            assert link.backlog_bytes(now_ns) <= direction.buffer_bytes
        if passage.drop is DropReason.OVERFLOW:
            assert link.backlog_bytes(now_ns) == before_bytes


@given(directions(), traffic)
def test_packets_arrive_in_order_without_reordering(
    direction: DirectionProfile, offered: list[tuple[int, int]]
) -> None:
    passages = [passage for _, passage in carry(direction, offered)]
    arrivals_ns = [at for passage in passages for at in passage.arrivals_ns]
    assert arrivals_ns == sorted(arrivals_ns)
    assert all(p.arrivals_ns[0] >= p.departure_ns for p in passages if p.departure_ns is not None)


@given(st.integers(0, 100), st.sampled_from(JitterShape))
def test_jitter_keeps_the_order_unless_it_may_not(seed: int, shape: JitterShape) -> None:
    def arrivals_ns(reorder: bool) -> list[int]:
        band = Band(S, 10**9, 50 * MS, jitter_ns=20 * MS, jitter_shape=shape, reorder=reorder)
        passages = carry(DirectionProfile((band,)), [(100, MS)] * 100, seed)
        return [passage.arrivals_ns[0] for _, passage in passages]

    in_order, free = arrivals_ns(False), arrivals_ns(True)
    assert in_order == sorted(in_order)
    assert free != sorted(free)
    assert list(accumulate(free, max)) == in_order


@given(directions_of_any_kind(), traffic, st.integers())
def test_the_same_seed_gives_the_same_passages(
    direction: DirectionProfile, offered: list[tuple[int, int]], seed: int
) -> None:
    assert carry(direction, offered, seed) == carry(direction, offered, seed)


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("loss_ratio", [0.01, 0.1, 0.3])
def test_loss_is_within_its_binomial_error(loss_ratio: float, seed: int) -> None:
    count = 20_000
    band = Band(S, 10**9, 0, loss_ratio=loss_ratio)
    passages = [passage for _, passage in carry(DirectionProfile((band,)), [(100, MS)] * count, seed)]
    lost = sum(p.drop is DropReason.LOSS for p in passages)
    assert abs(lost - count * loss_ratio) < 4 * math.sqrt(count * loss_ratio * (1 - loss_ratio))
    runs = sum(
        a.drop is not b.drop for a, b in pairwise(passages)
    )  # independent: changes 2 p (1 - p) of the time
    assert abs(runs / count - 2 * loss_ratio * (1 - loss_ratio)) < 0.02


@pytest.mark.parametrize(("shape", "mean_ms"), [(JitterShape.HALF_NORMAL, 7.98), (JitterShape.UNIFORM, 5.0)])
def test_jitter_has_the_mean_of_its_shape(shape: JitterShape, mean_ms: float) -> None:
    band = Band(S, 10**9, 0, jitter_ns=10 * MS, jitter_shape=shape, reorder=True)
    extras_ms = sorted(
        (passage.arrivals_ns[0] - (passage.departure_ns or 0)) / MS
        for _, passage in carry(DirectionProfile((band,)), [(100, MS)] * 20_000)
    )
    assert sum(extras_ms) / len(extras_ms) == pytest.approx(mean_ms, abs=0.15)
    assert extras_ms[0] >= 0
    assert shape is JitterShape.HALF_NORMAL or bisect_right(extras_ms, 10.0) == len(extras_ms)

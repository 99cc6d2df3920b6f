"""How well one direction of a link was used: a judge of its own, from what entered the link and when.

It replays the departures through the link's model, so that nothing that the estimator or the mission says
of itself is believed. Queueing delay is the time until the last queued bit has left, on a grid of true time.
"""

from __future__ import annotations

import random
from bisect import bisect_left
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from netem_scripts.band import Band, DirectionProfile
from netem_scripts.link import DropReason, Link
from netem_scripts.schedule import FOREVER_NS

GRID_NS = 5_000_000
LONG_QUEUE_NS = 100_000_000
WINDOW_NS = 10_000_000_000
_TELLING_NS, _TELLING_RATIO = 20_000_000, 1.25  # a way back that is slower by this much tells something
REACTION_NS = 250_000_000  # a rate is what enters the link over so long
NS_PER_S = 1_000_000_000

Times = NDArray[np.int64]
Packet = tuple[int, int]  # when it entered (ns), bytes on the wire


@dataclass(frozen=True, slots=True)
class Change:
    """A change of rate between two bands that both carry something.

    reaction_s: until what enters is at most 1.06, or at least 0.85, of the new rate; NaN: never.
    peak_s: the longest queue in the new band. bound_s: what of it is sent before anybody can know.
    """

    at_s: float
    old_bps: int
    new_bps: int
    reaction_s: float
    peak_s: float
    bound_s: float


@dataclass(frozen=True, slots=True)
class Recovery:
    """The end of a blackout. back_s: until what enters is at least 0.5 of the rate, or the queue holds it."""

    at_s: float
    back_s: float


@dataclass(slots=True)
class Score:
    """One direction while the link is up. queue_ns: samples on the grid; windows: worst use of any 10 s."""

    served_bits: int
    capacity_bits: int
    queue_ns: Times
    tail_drops: int
    changes: list[Change]
    recoveries: list[Recovery]
    worst_window: float

    @property
    def utilisation(self) -> float:
        return self.served_bits / max(1, self.capacity_bits)

    @property
    def long_queue_ratio(self) -> float:
        """Share of the up-time with more than 100 ms of queue."""
        return float(np.mean(self.queue_ns > LONG_QUEUE_NS))

    def queue_ms(self, percentile: float) -> float:
        return float(np.percentile(self.queue_ns, percentile)) / 1e6


def judge(ours: DirectionProfile, theirs: DirectionProfile, packets: list[Packet], duration_ns: int) -> Score:
    """Score what one direction carried. theirs: the way back, by which news of a change comes."""
    link = Link(ours, random.Random(0))
    empties: list[tuple[int, int]] = []
    drops = 0
    for at_ns, wire_bytes in packets:
        if at_ns >= duration_ns:
            break
        passage = link.transmit(wire_bytes - ours.overhead_bytes, at_ns)
        drops += passage.drop is DropReason.OVERFLOW
        if passage.departure_ns is not None:
            empties.append((at_ns, passage.departure_ns))
    grid = np.arange(0, duration_ns, GRID_NS)
    queue = _until_empty(empties, grid)
    spans = _spans(link, duration_ns)
    up = np.zeros(grid.size, dtype=bool)
    capacity = served = 0
    clocked = Link(ours, random.Random(0))
    served_at = _served_at(clocked, packets, [edge for begin, end, _ in spans for edge in (begin, end)])
    for begin, end, band in spans:
        if _carries(band):
            up[(grid >= begin) & (grid < end)] = True
            capacity += link.capacity_bits(begin, end)
            served += served_at[end] - served_at[begin]
    entered = np.array([p[0] for p in packets] or [0], dtype=np.int64)
    sums = np.concatenate([[0], np.cumsum([p[1] for p in packets] or [0])]).astype(np.int64)
    changes = _changes(link, Link(theirs, random.Random(0)), spans, entered, sums, grid, queue)
    recoveries = [
        Recovery(begin / 1e9, _first_rate(entered, sums, begin, end, 0.5 * band.rate_bps, rising=True))
        for (_, _, before), (begin, end, band) in pairwise(spans)
        if _carries(band) and not _carries(before) and end - begin > NS_PER_S
    ]
    worst = min((use for use, _ in stable_windows(ours, packets, duration_ns)), default=float("nan"))
    return Score(served, capacity, queue[up], drops, changes, recoveries, worst)


def _carries(band: Band) -> bool:
    return band.rate_bps > 0 and band.loss_ratio < 1


def _until_empty(empties: list[tuple[int, int]], grid: Times) -> Times:
    if not empties:
        return np.zeros(grid.size, dtype=np.int64)
    at, departure = (np.array(column, dtype=np.int64) for column in zip(*empties, strict=True))
    index = np.searchsorted(at, grid, side="right") - 1
    empty_at = np.where(index >= 0, departure[np.maximum(index, 0)], 0)
    return np.maximum(0, empty_at - grid)


def spans_of(direction: DirectionProfile, duration_ns: int) -> list[tuple[int, int, Band]]:
    """The bands of a mission: from when, until when, which."""
    return _spans(Link(direction, random.Random(0)), duration_ns)


def _spans(link: Link, duration_ns: int) -> list[tuple[int, int, Band]]:
    spans, at_ns = [], 0
    while at_ns < duration_ns:
        end_ns = min(link.next_change_ns(at_ns) or FOREVER_NS, duration_ns)
        spans.append((at_ns, end_ns, link.band_at(at_ns)))
        at_ns = end_ns
    return spans


def _served_at(link: Link, packets: list[Packet], edges: list[int]) -> dict[int, int]:
    """Bits served up to each edge."""
    served: dict[int, int] = {}
    pending = sorted(set(edges))
    for at_ns, wire_bytes in packets:
        while pending and pending[0] <= at_ns:
            served[pending[0]] = link.served_bits(pending[0])
            pending.pop(0)
        if not pending:
            break
        link.transmit(wire_bytes - link._overhead_bytes, at_ns)
    for edge in pending:
        served[edge] = link.served_bits(edge)
    return served


def _changes(
    link: Link,
    back: Link,
    spans: list[tuple[int, int, Band]],
    entered: Times,
    sums: Times,
    grid: Times,
    queue: Times,
) -> list[Change]:
    changes = []
    for (_, _, old), (begin, end, new) in pairwise(spans):
        if not (_carries(old) and _carries(new)) or old.rate_bps == new.rate_bps or end - begin < NS_PER_S:
            continue
        rising = new.rate_bps > old.rate_bps
        target = new.rate_bps * (0.85 if rising else 1.06)
        reaction = _first_rate(entered, sums, begin, end, target, rising=rising)
        peak = int(queue[(grid >= begin) & (grid < end)].max())
        blind_ns = _blind_ns(old, back.band_at(begin - 1), back.band_at(begin))
        bound = max(0, old.rate_bps - new.rate_bps) / new.rate_bps * blind_ns
        changes.append(Change(begin / 1e9, old.rate_bps, new.rate_bps, reaction, peak / 1e9, bound / 1e9))
    return changes


def _blind_ns(old: Band, back_old: Band, back_new: Band) -> int:
    """How long after a change no sender can know of it, without loss.

    Where the way back becomes slower with ours, the peer's next datagram fails to come: that is news after
    the way back's delay. One that is as before, or better, says nothing of our direction: then the first of
    our datagrams must fail to arrive there, and the peer speak of that.
    """
    worse = back_new.one_way_delay_ns > back_old.one_way_delay_ns + _TELLING_NS
    worse |= back_new.rate_bps * _TELLING_RATIO < back_old.rate_bps
    if worse:
        return back_old.one_way_delay_ns
    spoken_ns = old.one_way_delay_ns + back_new.one_way_delay_ns
    return max(spoken_ns, back_old.one_way_delay_ns)


def _first_rate(
    entered: Times, sums: Times, begin_ns: int, end_ns: int, target_bps: float, *, rising: bool
) -> float:
    """Seconds after begin at which the rate over the next 250 ms (and two datagrams) is on the right side."""
    datagram_bits = 8 * 1228 if not rising else 0
    window_ns = max(REACTION_NS, round(2 * 8 * 700 / target_bps * NS_PER_S))
    for at_ns in range(begin_ns, end_ns - window_ns, 5_000_000):
        first, last = bisect_left(entered, at_ns), bisect_left(entered, at_ns + window_ns)
        bits = 8 * int(sums[last] - sums[first])
        limit = target_bps * window_ns / NS_PER_S
        if (bits >= limit) if rising else (bits <= limit + datagram_bits):
            return (at_ns - begin_ns) / 1e9
    return float("nan")


def stable_windows(
    ours: DirectionProfile, packets: list[Packet], duration_ns: int
) -> list[tuple[float, int]]:
    """Of each 10 s in which the link has been stable for 5 round trips and 2 s: the use, and the begin."""
    windows: list[tuple[int, int]] = []  # when it begins, and the rate
    for begin, end, band in _spans(Link(ours, random.Random(0)), duration_ns):
        if _carries(band):
            start = begin + 10 * band.one_way_delay_ns + 2 * NS_PER_S
            windows += [(at, band.rate_bps) for at in range(start, end - WINDOW_NS + 1, NS_PER_S)]
    edges = [edge for begin, _ in windows for edge in (begin, begin + WINDOW_NS)]
    served = _served_at(Link(ours, random.Random(0)), packets, edges)
    return [
        ((served[begin + WINDOW_NS] - served[begin]) * NS_PER_S / (WINDOW_NS * rate_bps), begin)
        for begin, rate_bps in windows
    ]

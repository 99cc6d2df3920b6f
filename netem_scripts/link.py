"""One direction of a thin link: a buffer, a server of scheduled rate, a delay line, and their faults.

The rate is a known function of time, so the fate of a packet is known when it enters: no timer, no state
machine and no token bucket (a bucket's burst would hide the queue that is to be measured).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import StrEnum
from heapq import heappop, heappush
from typing import NamedTuple

from .band import Band, DirectionProfile, Order
from .chance import Chance, RandomSource
from .delay_first import DelayFirst
from .schedule import FOREVER_NS, NANOBITS_PER_BIT, NANOBITS_PER_BYTE, Schedule, Segment

__all__ = ["DropReason", "Link", "LinkError", "LinkTotals", "Passage", "RandomSource"]

_NO_LIMIT_NANOBITS = 1 << 100


class LinkError(Exception):
    """The link was used wrongly: time went backwards."""


class DropReason(StrEnum):
    """Why a packet never arrives."""

    OVERFLOW = "OVERFLOW"
    """It did not fit the buffer (tail drop) and took no capacity."""
    LOSS = "LOSS"
    """Chance took it: behind the queue, where it has occupied the link like any other; in the order
    delay-then-rate before the queue, where it has taken no capacity."""
    OVERSIZE = "OVERSIZE"
    """It was larger than the MTU and took no capacity."""


class Passage(NamedTuple):
    """What becomes of one packet; a tuple, since hundreds of thousands are made per mission.

    wire_bytes: payload and overhead.
    queue_delay_ns: from entry into the queue until its first bit leaves; for an OVERFLOW, what it would have
        waited; 0 for what never came to the queue.
    departure_ns: when its last bit leaves the queue; None for what was not queued.
    arrivals_ns: none if dropped, two if duplicated.
    corrupted_bit: which bit of the payload arrives flipped; None if none does.
    """

    wire_bytes: int
    queue_delay_ns: int
    departure_ns: int | None
    arrivals_ns: tuple[int, ...]
    drop: DropReason | None
    corrupted_bit: int | None = None


@dataclass(frozen=True, slots=True)
class LinkTotals:
    """Packets so far, of which always
    offered + duplicated = oversized + overflowed + lost + delivered + in_transit.
    """

    offered: int
    duplicated: int
    overflowed: int
    lost: int
    delivered: int
    in_transit: int
    oversized: int = 0


class Link:
    """One direction. now_ns counts from the start of the schedule and never goes backwards."""

    __slots__ = (
        "_accepted_bytes",
        "_chance",
        "_delay_first",
        "_departures_ns",
        "_direction",
        "_duplicated",
        "_entry",
        "_finish_nanobits",
        "_last_arrival_ns",
        "_last_departure_ns",
        "_limit_nanobits",
        "_lost",
        "_now_ns",
        "_offered",
        "_overflowed",
        "_overhead_bytes",
        "_oversized",
        "_pending_ns",
        "_plain",
        "_schedule",
        "_server",
    )

    def __init__(self, direction: DirectionProfile, rng: RandomSource) -> None:
        self._direction = direction
        self._overhead_bytes = direction.overhead_bytes
        self._schedule = Schedule(direction)
        self._chance = Chance(rng)
        delay_first = direction.order is Order.DELAY_THEN_RATE
        self._delay_first = DelayFirst(direction, self._schedule) if delay_first else None
        self._departures_ns: deque[int] = deque()  # of the queue, unless plain
        self._plain = not (
            delay_first or direction.mtu_bytes or direction.buffer_packets or direction.minimum_bytes
        )
        self._now_ns = 0
        self._entry = self._enter(0)  # the band in force now
        self._server = self._schedule.segment_serving(0)  # the band that serves the end of the queue
        self._finish_nanobits = 0  # the capacity that will have been offered when the queue is empty
        self._last_departure_ns = 0
        self._last_arrival_ns = 0
        self._pending_ns: list[int] = []  # heap of the arrivals to come
        self._accepted_bytes = 0
        self._offered = self._duplicated = self._overflowed = self._lost = self._oversized = 0

    def transmit(self, payload_bytes: int, now_ns: int) -> Passage:
        """Enter one packet at now_ns and learn its fate.

        Raises LinkError when now_ns is before the last one given.
        """
        self._advance(now_ns)
        self._offered += 1
        wire_bytes = payload_bytes + self._overhead_bytes
        if not self._plain:
            wire_bytes = max(wire_bytes, self._direction.minimum_bytes)
            passage = self._pass_by_queue(payload_bytes, wire_bytes, now_ns)
            if passage is not None:
                return passage
        entry, server = self._entry, self._server
        offered_nanobits = entry.start_nanobits + (now_ns - entry.start_ns) * entry.rate_bps
        begin = self._finish_nanobits
        if begin < offered_nanobits:
            begin = offered_nanobits
        finish = begin + wire_bytes * NANOBITS_PER_BYTE
        if begin >= server.end_nanobits:
            server = self._schedule.segment_serving(begin)
        start_ns = max(now_ns, self._last_departure_ns, server.start_ns)
        if finish - offered_nanobits > self._limit_nanobits:
            self._overflowed += 1
            return Passage(wire_bytes, start_ns - now_ns, None, (), DropReason.OVERFLOW)

        if finish > server.end_nanobits:
            server = self._schedule.segment_serving(finish - 1)
        # Rounded up: the last bit is never out before the link has offered the capacity for it.
        departure_ns = server.start_ns - (server.start_nanobits - finish) // server.rate_bps
        self._server = server
        self._finish_nanobits = finish
        self._last_departure_ns = departure_ns
        self._accepted_bytes += wire_bytes
        if not self._plain:
            self._departures_ns.append(departure_ns)
        if not server.ideal:
            return self._carry(server.band, payload_bytes, wire_bytes, start_ns - now_ns, departure_ns)
        arrival_ns = departure_ns + server.one_way_delay_ns
        if arrival_ns < self._last_arrival_ns:
            arrival_ns = self._last_arrival_ns
        self._last_arrival_ns = arrival_ns
        heappush(self._pending_ns, arrival_ns)
        return Passage(wire_bytes, start_ns - now_ns, departure_ns, (arrival_ns,), None)

    def band_at(self, now_ns: int) -> Band:
        """The band in force at now_ns, past or future."""
        return self._schedule.segment_at(now_ns).band

    def next_change_ns(self, now_ns: int) -> int | None:
        """When the band in force at now_ns ends; None if it lasts for ever."""
        end_ns = self._schedule.segment_at(now_ns).end_ns
        return None if end_ns == FOREVER_NS else end_ns

    def capacity_bits(self, start_ns: int, end_ns: int) -> int:
        """What the schedule offers between two instants; adjoining intervals add up exactly."""
        schedule = self._schedule
        return (
            schedule.nanobits_at(end_ns) // NANOBITS_PER_BIT
            - schedule.nanobits_at(start_ns) // NANOBITS_PER_BIT
        )

    def backlog_bytes(self, now_ns: int) -> int:
        """What is queued or half served at now_ns, headers included, rounded up to whole bytes."""
        unserved = self._unserved_nanobits(now_ns)
        if self._delay_first is not None:
            unserved -= self._delay_first.delayed_nanobits(now_ns)
        return -(-unserved // NANOBITS_PER_BYTE)

    def served_bits(self, now_ns: int) -> int:
        """What the link has served from t = 0 to now_ns, headers included, rounded down."""
        accepted_nanobits = self._accepted_bytes * NANOBITS_PER_BYTE
        return (accepted_nanobits - self._unserved_nanobits(now_ns)) // NANOBITS_PER_BIT

    def totals(self, now_ns: int) -> LinkTotals:
        """The balance of packets at now_ns."""
        self._advance(now_ns)
        in_transit = len(self._pending_ns)
        carried = self._offered + self._duplicated - self._oversized - self._overflowed - self._lost
        return LinkTotals(
            offered=self._offered,
            duplicated=self._duplicated,
            overflowed=self._overflowed,
            lost=self._lost,
            delivered=carried - in_transit,
            in_transit=in_transit,
            oversized=self._oversized,
        )

    def _advance(self, now_ns: int) -> None:
        if now_ns < self._now_ns:
            raise LinkError(f"A link's now_ns = {now_ns} must not be before the last one, {self._now_ns}.")
        self._now_ns = now_ns
        if now_ns >= self._entry.end_ns:
            self._entry = self._enter(now_ns)
        pending_ns = self._pending_ns
        while pending_ns and pending_ns[0] <= now_ns:
            heappop(pending_ns)

    def _enter(self, now_ns: int) -> Segment:
        entry = self._schedule.segment_at(now_ns)
        limit = _NO_LIMIT_NANOBITS
        if self._direction.buffer_bytes is not None:
            limit = self._direction.buffer_bytes * NANOBITS_PER_BYTE
        if self._direction.buffer_ns is not None:
            limit = min(limit, self._direction.buffer_ns * entry.drain_rate_bps)
        self._limit_nanobits = limit
        return entry

    def _unserved_nanobits(self, now_ns: int) -> int:
        self._advance(now_ns)
        offered_nanobits = self._schedule.nanobits_at(now_ns)
        if self._delay_first is not None:
            return self._delay_first.unserved_nanobits(offered_nanobits)
        return max(0, self._finish_nanobits - offered_nanobits)

    def _pass_by_queue(self, payload_bytes: int, wire_bytes: int, now_ns: int) -> Passage | None:
        """The fate of a packet that is too large, that finds too many, or that is delayed first."""
        direction = self._direction
        if direction.mtu_bytes is not None and wire_bytes > direction.mtu_bytes:
            self._oversized += 1
            return Passage(wire_bytes, 0, None, (), DropReason.OVERSIZE)
        if self._delay_first is not None:
            return self._delay(self._delay_first, payload_bytes, wire_bytes, now_ns)
        departures_ns = self._departures_ns
        while departures_ns and departures_ns[0] <= now_ns:
            departures_ns.popleft()
        if direction.buffer_packets is None or len(departures_ns) < direction.buffer_packets:
            return None
        self._overflowed += 1
        wait_ns = self._last_departure_ns - now_ns
        return Passage(wire_bytes, wait_ns, None, (), DropReason.OVERFLOW)

    def _carry(
        self, band: Band, payload_bytes: int, wire_bytes: int, queue_delay_ns: int, departure_ns: int
    ) -> Passage:
        """What happens behind the queue: loss, then duplication, corruption, and delay per copy."""
        chance = self._chance
        if chance.loses(band):
            self._lost += 1
            return Passage(wire_bytes, queue_delay_ns, departure_ns, (), DropReason.LOSS)
        copies = 2 if chance.duplicates(band) else 1
        self._duplicated += copies - 1
        corrupted_bit = chance.corrupted_bit(band, payload_bytes)
        arrivals_ns = tuple([self._arrive(band, departure_ns) for _ in range(copies)])
        return Passage(wire_bytes, queue_delay_ns, departure_ns, arrivals_ns, None, corrupted_bit)

    def _arrive(self, band: Band, departure_ns: int) -> int:
        arrival_ns = departure_ns + band.one_way_delay_ns + self._chance.jitter_ns(band)
        if not band.reorder:
            arrival_ns = max(arrival_ns, self._last_arrival_ns)
        self._last_arrival_ns = max(arrival_ns, self._last_arrival_ns)
        heappush(self._pending_ns, arrival_ns)
        return arrival_ns

    def _delay(self, line: DelayFirst, payload_bytes: int, wire_bytes: int, now_ns: int) -> Passage:
        """The order delay-then-rate: loss, duplication, corruption, the delay line, then the buffer."""
        band, chance = self._entry.band, self._chance
        if chance.loses(band):
            self._lost += 1
            return Passage(wire_bytes, 0, None, (), DropReason.LOSS)
        copies = 2 if chance.duplicates(band) else 1
        self._duplicated += copies - 1
        corrupted_bit = chance.corrupted_bit(band, payload_bytes)
        first_wait_ns, departures_ns = 0, []
        for copy in range(copies):
            reach_ns = now_ns + band.one_way_delay_ns + chance.jitter_ns(band)
            wait_ns, departure_ns = line.enter(wire_bytes, reach_ns, now_ns, band.reorder)
            if copy == 0:
                first_wait_ns = wait_ns
            if departure_ns is None:
                self._overflowed += 1
                continue
            self._accepted_bytes += wire_bytes
            heappush(self._pending_ns, departure_ns)
            departures_ns.append(departure_ns)
        if not departures_ns:
            return Passage(wire_bytes, first_wait_ns, None, (), DropReason.OVERFLOW)
        return Passage(wire_bytes, first_wait_ns, departures_ns[0], tuple(departures_ns), None, corrupted_bit)

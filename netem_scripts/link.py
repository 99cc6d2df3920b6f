"""One direction of a thin link: a buffer, a server of scheduled rate, a delay line, and their faults.

The rate is a known function of time, so the fate of a packet is known when it enters: no timer, no state
machine and no token bucket (a bucket's burst would hide the queue that is to be measured).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from heapq import heappop, heappush
from typing import NamedTuple, Protocol

from .band import Band, DirectionProfile, JitterShape
from .schedule import FOREVER_NS, NANOBITS_PER_BIT, NANOBITS_PER_BYTE, Schedule, Segment

_NO_LIMIT_NANOBITS = 1 << 100


class LinkError(Exception):
    """The link was used wrongly: time went backwards."""


class RandomSource(Protocol):
    """Where chance comes from; random.Random fits."""

    def random(self) -> float: ...
    def gauss(self, mu: float, sigma: float) -> float: ...
    def getrandbits(self, k: int, /) -> int: ...


class DropReason(StrEnum):
    """Why a packet never arrives."""

    OVERFLOW = "OVERFLOW"
    """It did not fit the buffer (tail drop) and took no capacity."""
    LOSS = "LOSS"
    """It was lost behind the queue: it has occupied the link like any other."""


class Passage(NamedTuple):
    """What becomes of one packet; a tuple, since hundreds of thousands are made per mission.

    wire_bytes: payload and overhead.
    queue_delay_ns: from entry until its first bit leaves; for an OVERFLOW, what it would have waited.
    departure_ns: when its last bit leaves the queue; None for an OVERFLOW.
    arrivals_ns: none if dropped, two if duplicated.
    """

    wire_bytes: int
    queue_delay_ns: int
    departure_ns: int | None
    arrivals_ns: tuple[int, ...]
    drop: DropReason | None


@dataclass(frozen=True, slots=True)
class LinkTotals:
    """Packets so far: offered + duplicated = overflowed + lost + delivered + in_transit, always."""

    offered: int
    duplicated: int
    overflowed: int
    lost: int
    delivered: int
    in_transit: int


class Link:
    """One direction. now_ns counts from the start of the schedule and never goes backwards."""

    __slots__ = (
        "_accepted_bytes",
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
        "_pending_ns",
        "_rng",
        "_schedule",
        "_server",
    )

    def __init__(self, direction: DirectionProfile, rng: RandomSource) -> None:
        self._direction = direction
        self._overhead_bytes = direction.overhead_bytes
        self._schedule = Schedule(direction)
        self._rng = rng
        self._now_ns = 0
        self._entry = self._enter(0)  # the band in force now
        self._server = self._schedule.segment_serving(0)  # the band that serves the end of the queue
        self._finish_nanobits = 0  # the capacity that will have been offered when the queue is empty
        self._last_departure_ns = 0
        self._last_arrival_ns = 0
        self._pending_ns: list[int] = []  # heap of the arrivals to come
        self._accepted_bytes = 0
        self._offered = self._duplicated = self._overflowed = self._lost = 0

    def transmit(self, payload_bytes: int, now_ns: int) -> Passage:
        """Enter one packet at now_ns and learn its fate.

        Raises LinkError when now_ns is before the last one given.
        """
        self._advance(now_ns)
        entry, server = self._entry, self._server
        wire_bytes = payload_bytes + self._overhead_bytes
        offered_nanobits = entry.start_nanobits + (now_ns - entry.start_ns) * entry.rate_bps
        begin = self._finish_nanobits
        if begin < offered_nanobits:
            begin = offered_nanobits
        finish = begin + wire_bytes * NANOBITS_PER_BYTE
        self._offered += 1
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
        if not server.ideal:
            arrivals_ns = self._carry(server.band, departure_ns)
            drop = None if arrivals_ns else DropReason.LOSS
            return Passage(wire_bytes, start_ns - now_ns, departure_ns, arrivals_ns, drop)
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
        return -(-self._backlog_nanobits(now_ns) // NANOBITS_PER_BYTE)

    def served_bits(self, now_ns: int) -> int:
        """What the link has served from t = 0 to now_ns, headers included, rounded down."""
        accepted_nanobits = self._accepted_bytes * NANOBITS_PER_BYTE
        return (accepted_nanobits - self._backlog_nanobits(now_ns)) // NANOBITS_PER_BIT

    def totals(self, now_ns: int) -> LinkTotals:
        """The balance of packets at now_ns."""
        self._advance(now_ns)
        in_transit = len(self._pending_ns)
        carried = self._offered + self._duplicated - self._overflowed - self._lost
        return LinkTotals(
            offered=self._offered,
            duplicated=self._duplicated,
            overflowed=self._overflowed,
            lost=self._lost,
            delivered=carried - in_transit,
            in_transit=in_transit,
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

    def _backlog_nanobits(self, now_ns: int) -> int:
        self._advance(now_ns)
        return max(0, self._finish_nanobits - self._schedule.nanobits_at(now_ns))

    def _carry(self, band: Band, departure_ns: int) -> tuple[int, ...]:
        """What happens behind the queue: loss, then duplication, then delay and jitter per copy."""
        if band.loss_ratio and self._rng.random() < band.loss_ratio:
            self._lost += 1
            return ()
        if band.duplicate_ratio and self._rng.random() < band.duplicate_ratio:
            self._duplicated += 1
            return self._arrive(band, departure_ns), self._arrive(band, departure_ns)
        return (self._arrive(band, departure_ns),)

    def _arrive(self, band: Band, departure_ns: int) -> int:
        arrival_ns = departure_ns + band.one_way_delay_ns
        if band.jitter_ns:
            arrival_ns += self._jitter_ns(band)
        if not band.reorder:
            arrival_ns = max(arrival_ns, self._last_arrival_ns)
        self._last_arrival_ns = max(arrival_ns, self._last_arrival_ns)
        heappush(self._pending_ns, arrival_ns)
        return arrival_ns

    def _jitter_ns(self, band: Band) -> int:
        if band.jitter_shape is JitterShape.UNIFORM:
            return int(self._rng.random() * (band.jitter_ns + 1))
        return int(abs(self._rng.gauss(0.0, band.jitter_ns)))

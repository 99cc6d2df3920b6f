"""The order delay-then-rate: a delay line in front of the buffer and the server.

A packet's place at the server is promised when it enters the link, so its fate is known then. One that comes
to the server earlier than a packet that has entered before it takes capacity that is not promised yet.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from heapq import heappop, heappush

from .band import DirectionProfile
from .schedule import NANOBITS_PER_BYTE, Schedule


class Promises:
    """Capacity that belongs to packets: intervals that neither overlap nor touch, in nanobits."""

    __slots__ = ("_begins", "_ends")

    def __init__(self) -> None:
        self._begins: list[int] = []
        self._ends: list[int] = []

    def find(self, earliest: int, amount: int) -> tuple[int, int]:
        """The first and the end of the free capacity that `amount` takes from `earliest` on, gap by gap."""
        first, at, left = None, earliest, amount
        for index in range(bisect_right(self._ends, earliest), len(self._ends)):
            gap = self._begins[index] - at
            if gap > 0:
                first = at if first is None else first
                if gap >= left:
                    return first, at + left
                left -= gap
            at = self._ends[index]
        return (at if first is None else first), at + left

    def take(self, first: int, end: int) -> None:
        """Promise all that is free between the two, as find gave them."""
        low = bisect_left(self._ends, first)
        high = bisect_right(self._begins, end)
        if low < high:
            first, end = min(first, self._begins[low]), max(end, self._ends[high - 1])
        self._begins[low:high] = [first]
        self._ends[low:high] = [end]

    def after(self, now: int) -> int:
        """How much is promised beyond `now`; what lies before is forgotten, as time does not go back."""
        past = bisect_right(self._ends, now)
        del self._begins[:past], self._ends[:past]
        return sum(end - max(begin, now) for begin, end in zip(self._begins, self._ends, strict=True))


class DelayFirst:
    """The delay line and the server of one direction."""

    __slots__ = ("_direction", "_in_line", "_last_reach_ns", "_promises", "_queued", "_schedule")

    def __init__(self, direction: DirectionProfile, schedule: Schedule) -> None:
        self._direction = direction
        self._schedule = schedule
        self._promises = Promises()
        self._in_line: list[tuple[int, int]] = []  # heap: when it comes to the queue, its nanobits
        self._queued: list[tuple[int, int]] = []  # when each came to the queue and left it, if packets count
        self._last_reach_ns = 0

    def enter(self, wire_bytes: int, reach_ns: int, now_ns: int, reorder: bool) -> tuple[int, int | None]:
        """A packet enters at now_ns and comes to the queue at reach_ns, or later if it may not overtake.

        Returns what it waits there, and when its last bit leaves: None if it does not fit.
        """
        if not reorder:
            reach_ns = max(reach_ns, self._last_reach_ns)
        self._last_reach_ns = max(reach_ns, self._last_reach_ns)
        self._promises.after(self._schedule.nanobits_at(now_ns))
        earliest = self._schedule.nanobits_at(reach_ns)
        amount = wire_bytes * NANOBITS_PER_BYTE
        first, end = self._promises.find(earliest, amount)
        wait_ns = max(reach_ns, self._instant_ns(first, begins=True)) - reach_ns
        if end - earliest > self._limit_nanobits(reach_ns) or self._is_full(reach_ns, now_ns):
            return wait_ns, None
        departure_ns = self._instant_ns(end, begins=False)
        self._promises.take(first, end)
        heappush(self._in_line, (reach_ns, amount))
        if self._direction.buffer_packets is not None:
            self._queued.append((reach_ns, departure_ns))
        return wait_ns, departure_ns

    def unserved_nanobits(self, offered_nanobits: int) -> int:
        """What is delayed, queued or half served when the link has offered so much."""
        return self._promises.after(offered_nanobits)

    def delayed_nanobits(self, now_ns: int) -> int:
        """What has not come to the queue at now_ns."""
        while self._in_line and self._in_line[0][0] <= now_ns:
            heappop(self._in_line)
        return sum(nanobits for _, nanobits in self._in_line)

    def _instant_ns(self, nanobits: int, *, begins: bool) -> int:
        """When the capacity beyond `nanobits` begins to be offered, or all before it has been; rounded up."""
        segment = self._schedule.segment_serving(nanobits if begins else nanobits - 1)
        return segment.start_ns - (segment.start_nanobits - nanobits) // segment.rate_bps

    def _limit_nanobits(self, reach_ns: int) -> int:
        limits = [1 << 100]
        if self._direction.buffer_bytes is not None:
            limits.append(self._direction.buffer_bytes * NANOBITS_PER_BYTE)
        if self._direction.buffer_ns is not None:
            limits.append(self._direction.buffer_ns * self._schedule.segment_at(reach_ns).drain_rate_bps)
        return min(limits)

    def _is_full(self, reach_ns: int, now_ns: int) -> bool:
        limit = self._direction.buffer_packets
        if limit is None:
            return False
        self._queued = [(came_ns, left_ns) for came_ns, left_ns in self._queued if left_ns > now_ns]
        return sum(came_ns <= reach_ns < left_ns for came_ns, left_ns in self._queued) >= limit

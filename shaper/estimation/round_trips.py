"""The round trips of late: the newest, and the shortest, which is the one without a queue."""

from __future__ import annotations

from collections import deque

_MEMORY_NS = 10_000_000_000
_ASSUMED_NS = 200_000_000  # before any is known


class RoundTrips:
    """newest_ns: 0 before any is known."""

    __slots__ = ("_shortest", "newest_ns")

    def __init__(self) -> None:
        self.newest_ns = 0
        self._shortest: deque[tuple[int, int]] = deque()  # (when, rtt), each longer than the one before it

    @property
    def shortest_ns(self) -> int:
        """Of the last ten seconds."""
        return self._shortest[0][1] if self._shortest else _ASSUMED_NS

    def add(self, rtt_ns: int, now_ns: int) -> None:
        """One has been measured; it outlives all longer ones before it."""
        self.newest_ns = rtt_ns
        shortest = self._shortest
        while shortest and shortest[-1][1] >= rtt_ns:
            shortest.pop()
        shortest.append((now_ns, rtt_ns))
        while shortest[0][0] <= now_ns - _MEMORY_NS:
            shortest.popleft()

    def forget_all_but_the_newest(self) -> None:
        """The others were of another band."""
        while len(self._shortest) > 1:
            self._shortest.popleft()

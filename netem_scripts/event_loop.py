"""Virtual time: callbacks in the order of their instants, as fast as they run."""

from __future__ import annotations

from collections.abc import Callable
from heapq import heappop, heappush


class EventLoopError(Exception):
    """A callback was asked for in the past."""


class EventLoop:
    """A heap of callbacks. Callbacks of one instant run in the order in which they were asked for."""

    __slots__ = ("_heap", "_inserted", "now_ns")

    def __init__(self, start_ns: int = 0) -> None:
        self.now_ns = start_ns
        self._heap: list[tuple[int, int, Callable[[], None]]] = []
        self._inserted = 0

    def call_at(self, when_ns: int, callback: Callable[[], None]) -> None:
        """Run callback at when_ns; an instant equal to now runs after what is already due.

        Raises EventLoopError when when_ns is before now.
        """
        if when_ns < self.now_ns:
            raise EventLoopError(f"A callback's when_ns = {when_ns} must not be before now, {self.now_ns}.")
        heappush(self._heap, (when_ns, self._inserted, callback))
        self._inserted += 1

    def next_at_ns(self) -> int | None:
        """The instant of the next callback; None when there is none."""
        return self._heap[0][0] if self._heap else None

    def run_until(self, end_ns: int) -> None:
        """Run all that is due up to and including end_ns, then stand at end_ns."""
        heap = self._heap
        while heap and heap[0][0] <= end_ns:
            self.now_ns, _, callback = heappop(heap)
            callback()
        self.now_ns = max(self.now_ns, end_ns)

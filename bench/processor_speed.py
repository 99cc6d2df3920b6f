"""How fast the processor is while a bench runs.

On a shared machine a core slows down while a stranger uses the other half of it (its sibling thread), and
the kernel charges us for that time all the same: the same code takes half as much again from one minute to
the next. A gauge beside the bench times a loop that never changes.
"""

from __future__ import annotations

import subprocess
import sys
from types import TracebackType

import numpy as np

# Some 0.1 ms of integers, six times, five times a second: 0.3 % of a core, until its input is closed.
_GAUGE = """
import select, sys, time
def work():
    s = 0
    for i in range(2000): s += i * i % 7
taken_ns = []
while not select.select([sys.stdin], [], [], 0.2)[0]:
    work()  # what it takes to get warm is not what is asked
    for _ in range(5):
        began_ns = time.thread_time_ns()
        work()
        taken_ns.append(time.thread_time_ns() - began_ns)
print(*taken_ns)
"""
_BEST_PERCENTILE = 2.0


class ProcessorSpeed:
    """A process that gauges from entering the context to leaving it."""

    def __init__(self) -> None:
        self._taken_ns: list[int] = []

    @property
    def share_of_best(self) -> float:
        """The mean speed over the best of the run: 1 for a processor that nobody else used."""
        if not self._taken_ns:
            raise ValueError("the gauge has not had a quarter of a second")
        return float(np.percentile(self._taken_ns, _BEST_PERCENTILE) / np.mean(self._taken_ns))

    def __enter__(self) -> ProcessorSpeed:
        self._process = subprocess.Popen(
            [sys.executable, "-c", _GAUGE], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        said, _ = self._process.communicate()
        self._taken_ns = [int(word) for word in said.split()]

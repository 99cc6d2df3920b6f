"""How soon a sender's next datagram follows at the latest, in one byte: silence beyond it is news.

Steps of a sixteenth of an octave from 1 ms to 62 s, rounded up, so that a promise is never broken by
its coding. A receiver that knows when it must hear something notices a link's change before any report
could tell.
"""

from __future__ import annotations

from bisect import bisect_left

_STEPS_PER_OCTAVE = 16
PROMISES_NS = tuple(round(1_000_000 * 2 ** (code / _STEPS_PER_OCTAVE)) for code in range(256))


def promise_code(within_ns: int) -> int:
    """The code of the shortest promise that is no shorter than this; the longest there is beyond it."""
    return min(bisect_left(PROMISES_NS, within_ns), len(PROMISES_NS) - 1)

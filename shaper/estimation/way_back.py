"""The way back runs full: each of the peer's datagrams takes longer than the one before.

The peer keeps the queue of its direction short, so its link has fallen. Mostly ours has too, and where the
delay fell with the rate no silence tells of it: datagrams come spread, but soon. Our own reports would
tell only after they have waited in that very queue.
"""

from __future__ import annotations

FILLS_NS = 200_000_000  # longer in all than a full datagram takes (sizes.py): what the last ones rose by ...
RISES = 3  # ... at least so many in a row, each by ...
RISE_NS = 3_000_000  # ... more than this; one step alone is another delay
NOISE_FACTOR = 6.0


class WayBack:
    """Watches the peer's delays for a queue that grows; told once for each."""

    def __init__(self) -> None:
        self.began_ns = 0  # when the first datagram of the rise was heard
        self._delay_us: int | None = None
        self._rises = 0
        self._risen_ns = 0
        self._told = False

    def fills(self, sent_us: int, noise_ns: float, now_ns: int) -> bool:
        """A datagram has come, sent at this time of the peer's clock: whether that says so."""
        delay_us, before_us = now_ns // 1000 - sent_us, self._delay_us
        self._delay_us = delay_us
        if before_us is None:
            return False
        later_ns = (delay_us - before_us) * 1000
        least_ns = RISE_NS + noise_ns
        if later_ns < -least_ns:
            self._rises, self._risen_ns, self._told = 0, 0, False
        elif later_ns > least_ns:
            if not self._rises:
                self.began_ns = now_ns
            self._rises += 1
            self._risen_ns += later_ns
        grown = self._rises >= RISES and self._risen_ns > FILLS_NS + NOISE_FACTOR * noise_ns
        news = grown and not self._told
        self._told = self._told or grown
        return news

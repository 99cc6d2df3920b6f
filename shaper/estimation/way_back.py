"""The way back runs full: each of the peer's datagrams takes longer than the one before.

The peer keeps the queue of its direction short, so its link has fallen. Mostly ours has too, and where the
delay fell with the rate no silence tells of it: datagrams come spread, but soon. Our own reports would
tell only after they have waited in that very queue.
"""

from __future__ import annotations

FILLS_NS = 80_000_000  # longer in all, what their sizes explain taken off: what the last ones rose by ...
RISES = 3  # ... at least so many in a row, each by ...
RISE_NS = 1_500_000  # ... more than this; one step alone is another delay
NOISE_FACTOR = 6.0


class WayBack:
    """Watches the peer's delays for a queue that grows; told once for each."""

    def __init__(self) -> None:
        self.began_ns = 0  # when the first datagram of the rise was heard
        self._began_us: tuple[int, int] | None = None  # the delay then, with and without that of its size
        self._last_us = (0, 0)
        self._rises = 0
        self._noise_ns = 0.0  # before the rise, which is none
        self._told = False

    def fills(self, sent_us: int, promise_ns: int, noise_ns: float, now_ns: int) -> bool:
        """A datagram has come, sent at this time of the peer's clock: whether that says so.

        promise_ns: when the next one follows: in a backlog what this one takes, and small ones take less.
        """
        delay_us = now_ns // 1000 - sent_us
        delays_us = delay_us, delay_us - promise_ns // 1000
        later_ns = 1000 * min((a - b for a, b in zip(delays_us, self._last_us, strict=True)), key=abs)
        self._last_us = delays_us
        least_ns = RISE_NS + noise_ns
        if self._began_us is None or later_ns < -least_ns:
            self._began_us, self._rises, self._told = delays_us, 0, False
        elif later_ns > least_ns:
            if not self._rises:
                self.began_ns, self._noise_ns = now_ns, noise_ns
            self._rises += 1
        risen_ns = 1000 * min(a - b for a, b in zip(delays_us, self._began_us, strict=True))
        if risen_ns < least_ns:
            self._began_us, self._rises, self._told = delays_us, 0, False
        grown = self._rises >= RISES and risen_ns > FILLS_NS + NOISE_FACTOR * self._noise_ns
        news = grown and not self._told
        self._told = self._told or grown
        return news

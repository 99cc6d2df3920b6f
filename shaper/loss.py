"""How much of what we send is lost: a figure that is steady on a steady link and quick on a changed one."""

from __future__ import annotations

_FAST_PACKETS = 200  # averaged over about this many: quick, and off by 1.5 points at 10 % of loss
_SLOW_PACKETS = 1000  # and off by less than one point
# Standard deviations of the fast average, beyond which the loss has changed. A picture that has too little
# parity is gone, one with too much costs bytes: the way down takes more evidence than the way up.
_DOUBT_UP, _DOUBT_DOWN = 3.0, 4.0


class LossMeter:
    """Two moving averages: the slow one is believed until the fast one contradicts it.

    Until there have been that many packets, each is the plain mean of those that there were: the second
    picture on a link already has the parity that it needs.
    """

    __slots__ = ("_fast", "_settled", "_slow")

    def __init__(self) -> None:
        self._fast = self._slow = 0.0
        self._settled = 0

    @property
    def ratio(self) -> float:
        """0..1, of the packets that were settled lately."""
        return self._slow

    def on_settled(self, *, lost: bool) -> None:
        """A packet has arrived, or is given up."""
        self._settled += 1
        self._fast += (lost - self._fast) / min(_FAST_PACKETS, self._settled)
        self._slow += (lost - self._slow) / min(_SLOW_PACKETS, self._settled)
        self._compare()

    def on_came_after_all(self) -> None:
        """A packet that was given up has arrived."""
        settled = max(1, self._settled)
        self._fast = max(0.0, self._fast - 1.0 / min(_FAST_PACKETS, settled))
        self._slow = max(0.0, self._slow - 1.0 / min(_SLOW_PACKETS, settled))
        self._compare()

    def _compare(self) -> None:
        if self._settled < _FAST_PACKETS:
            return
        ratio = max(self._slow, self._fast)
        doubt = _DOUBT_UP if self._fast > self._slow else _DOUBT_DOWN
        gone = self._fast < self._slow / 2
        if gone or (self._fast - self._slow) ** 2 > doubt**2 * ratio * (1.0 - ratio) / (2 * _FAST_PACKETS):
            self._slow = self._fast

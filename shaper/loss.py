"""How much of what we send is lost: a figure that is steady on a steady link and quick on a changed one."""

from __future__ import annotations

_FAST_PACKETS = 200  # averaged over about this many: quick, and off by 2 points at 10 % of loss
_SLOW_PACKETS = 1000  # and off by less than one point
_DOUBT = 2.5  # standard deviations of the fast average, beyond which the loss has changed


class LossMeter:
    """Two moving averages: the slow one is believed until the fast one contradicts it."""

    __slots__ = ("_fast", "_slow")

    def __init__(self) -> None:
        self._fast = self._slow = 0.0

    @property
    def ratio(self) -> float:
        """0..1, of the packets that were settled lately."""
        return self._slow

    def on_settled(self, *, lost: bool) -> None:
        """A packet has arrived, or is given up."""
        self._fast += (lost - self._fast) / _FAST_PACKETS
        self._slow += (lost - self._slow) / _SLOW_PACKETS
        self._compare()

    def on_came_after_all(self) -> None:
        """A packet that was given up has arrived."""
        self._fast = max(0.0, self._fast - 1.0 / _FAST_PACKETS)
        self._slow = max(0.0, self._slow - 1.0 / _SLOW_PACKETS)
        self._compare()

    def _compare(self) -> None:
        ratio = max(self._slow, self._fast)
        gone = self._fast < self._slow / 2
        if gone or (self._fast - self._slow) ** 2 > _DOUBT**2 * ratio * (1.0 - ratio) / (2 * _FAST_PACKETS):
            self._slow = self._fast

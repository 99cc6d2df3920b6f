"""How many of the initiations that come the kernel should let through, so that a flood takes no more room.

Forged ones would fill the socket's buffer, and the peer's own datagrams would find no place in it. While
they are more than a few hundred a second only one in n passes. Those from the peer's own address have a gate
of their own: a stranger's flood does not keep out a peer that starts anew where it was.
"""

from __future__ import annotations

_NS_PER_S = 1_000_000_000
_LOOK_NS = _NS_PER_S // 10
_SUDDEN, _LEAST_NS = 64, 1_000_000  # so many at once are looked at without waiting
_TOO_MANY_PER_S, _FEW_PER_S = 200, 25
_AIM_PER_S = 100
_MOST = 4096


class FloodGate:
    """one_in: a power of two; 1 lets all through."""

    __slots__ = ("_looked_ns", "_unwanted", "one_in")

    def __init__(self, now_ns: int) -> None:
        self.one_in = 1
        self._looked_ns = now_ns
        self._unwanted = 0

    def look(self, unwanted: int, now_ns: int) -> int:
        """What one_in should be now. unwanted: initiations so far that were not answered."""
        count, elapsed_ns = unwanted - self._unwanted, now_ns - self._looked_ns
        if elapsed_ns < _LOOK_NS and count < _SUDDEN:
            return self.one_in
        self._looked_ns, self._unwanted = now_ns, unwanted
        per_s = count * _NS_PER_S // max(_LEAST_NS, elapsed_ns)
        if per_s > _TOO_MANY_PER_S:
            while per_s > _AIM_PER_S and self.one_in < _MOST:
                self.one_in, per_s = self.one_in * 2, per_s // 2
        elif per_s < _FEW_PER_S and elapsed_ns >= _LOOK_NS:
            self.one_in = max(1, self.one_in // 2)
        return self.one_in

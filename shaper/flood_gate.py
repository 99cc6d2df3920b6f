"""How many of the initiations that come the kernel should let through, so that a flood takes no more room.

Forged ones would fill the socket's buffer, and the peer's own datagrams would find no place in it. While
they are more than a few hundred a second only one in n passes; a peer that starts anew meanwhile is found
by our own initiation, whose answer the filter knows.
"""

from __future__ import annotations

_NS_PER_S = 1_000_000_000
_LOOK_NS = _NS_PER_S // 10
_TOO_MANY_PER_S, _FEW_PER_S = 400, 50
_MOST = 1024


class FloodGate:
    """one_in: a power of two; 1 lets all through."""

    def __init__(self, now_ns: int) -> None:
        self.one_in = 1
        self._looked_ns = now_ns
        self._unwanted = 0

    def look(self, unwanted: int, now_ns: int) -> int:
        """What one_in should be now. unwanted: initiations so far that were not answered."""
        elapsed_ns = now_ns - self._looked_ns
        if elapsed_ns < _LOOK_NS:
            return self.one_in
        per_s = (unwanted - self._unwanted) * _NS_PER_S // elapsed_ns
        self._looked_ns, self._unwanted = now_ns, unwanted
        if per_s > _TOO_MANY_PER_S:
            self.one_in = min(_MOST, self.one_in * 4)
        elif per_s < _FEW_PER_S:
            self.one_in = max(1, self.one_in // 2)
        return self.one_in

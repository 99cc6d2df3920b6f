"""How much of what is forged the kernel should let through, so that a flood takes no more room.

It would fill the socket's buffer, and the peer's own datagrams would find no place in it. While there are
more than a few hundred a second only one in n passes. Initiations from the peer's own address have a gate
of their own: a stranger's flood does not keep out a peer that starts anew where it was. Sealed datagrams
from there have none: whoever forges those can take the link away altogether.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

_NS_PER_S = 1_000_000_000
_LOOK_NS = _NS_PER_S // 10
_SUDDEN, _LEAST_NS = 64, 1_000_000  # so many at once are looked at without waiting
_TOO_MANY_PER_S, _FEW_PER_S = 200, 25
_AIM_PER_S = 100
_MOST = 4096


@dataclass(slots=True)
class Unwanted:
    """What came and was no use so far: forged, repeated, too many.

    of_peer: initiations from where the peer is or is looked for; initiations: from anywhere else.
    sealed: datagrams with a session's number, from anywhere else.
    """

    of_peer: int = 0
    initiations: int = 0
    sealed: int = 0

    @property
    def total(self) -> int:
        """All of them."""
        return self.of_peer + self.initiations + self.sealed


class Openings(NamedTuple):
    """Of how many one may pass, by the same kinds."""

    of_peer: int = 1
    initiations: int = 1
    sealed: int = 1


class FloodGates:
    """A gate for each kind."""

    def __init__(self, now_ns: int) -> None:
        self._of_peer, self._initiations, self._sealed = (FloodGate(now_ns) for _ in range(3))

    def look(self, unwanted: Unwanted, now_ns: int) -> Openings:
        """How far each should be open now."""
        return Openings(
            self._of_peer.look(unwanted.of_peer, now_ns),
            self._initiations.look(unwanted.initiations, now_ns),
            self._sealed.look(unwanted.sealed, now_ns),
        )


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

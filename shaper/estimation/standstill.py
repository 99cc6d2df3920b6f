"""A link that carried nothing for long, and kept what it held, tells its rate as soon as it carries again.

The peer's datagrams of that time come one behind the other, so their spacing is the way back's rate, a round
trip and a whole queue before our own are reported. If that is what it was, so is ours, most likely: the link
has been away, and is no other.
"""

from __future__ import annotations

from shaper.frames import NUMBER_BITS
from shaper.path import HeardPacket

STANDSTILL_NS = 1_000_000_000  # a silence at least so long ...
_LATE_SHARE = 0.8  # ... that ends with what is late by this share of it: it was in the link all the time
_LEAST_PAIRS, _LEAST_NS = 6, 20_000_000  # spacing over so many datagrams and so long tells ...
_NOISE_FACTOR = 10.0  # ... if it is longer than so many sigma of arrivals
_PATIENCE = 2  # times that: until then it should have
_SAME_RATIO = 1.25


class Standstill:
    """Looks at the peer's datagrams from the first one after a silence on.

    held: whether the link has kept what it was sent meanwhile. ended_ns: when the peer was heard again.
    """

    __slots__ = (
        "_bits",
        "_last_ns",
        "_least_ns",
        "_number",
        "_pairs",
        "_spread_ns",
        "_watching",
        "ended_ns",
        "held",
    )

    def __init__(self) -> None:
        self._watching = self.held = False
        self.ended_ns = 0
        self._number = self._last_ns = self._bits = self._pairs = self._spread_ns = self._least_ns = 0

    def end(self, packet: HeardPacket, silence_ns: int, later_ns: int, noise_ns: float, now_ns: int) -> None:
        """The peer is heard again.

        later_ns: by how much this datagram took longer than the one before it. noise_ns: one sigma of
        arrivals until then; what the link has held comes with other delays.
        """
        self.held = silence_ns > STANDSTILL_NS and later_ns > _LATE_SHARE * silence_ns
        self._watching = self.held
        self._number, self._last_ns, self.ended_ns = packet.number, now_ns, now_ns
        self._bits = self._pairs = self._spread_ns = 0
        self._least_ns = _LEAST_NS + int(_NOISE_FACTOR * noise_ns)

    @property
    def patience_ns(self) -> int:
        """For how long what the link holds may tell its rate, so that no train needs to."""
        return _PATIENCE * self._least_ns if self._watching else 0

    def is_as_before(self, packet: HeardPacket, now_ns: int) -> bool:
        """Whether the way back is known now to carry what it did; told once."""
        if not self._watching:
            return False
        if packet.number == (self._number + 1) % (1 << NUMBER_BITS):
            self._bits += 8 * packet.wire_bytes
            self._spread_ns += now_ns - self._last_ns
            self._pairs += 1
        self._number, self._last_ns = packet.number, now_ns
        if self._pairs < _LEAST_PAIRS or self._spread_ns < self._least_ns:
            return False
        self._watching = False
        carried_bps = self._bits * 1e9 / self._spread_ns
        return packet.peer_bps / _SAME_RATIO < carried_bps < packet.peer_bps * _SAME_RATIO

"""Wrapping counters of the wire, expanded to the plain integers that the core counts with."""

from __future__ import annotations


def expand(low_bits: int, bits: int, near: int) -> int:
    """The integer nearest to `near` whose low `bits` are `low_bits`; may be negative.

    As RFC 1982 compares serial numbers: right while the true value lies within half the range of near.
    """
    size = 1 << bits
    half = size >> 1
    return near + ((low_bits - near + half) % size) - half


def expand_above(low_bits: int, bits: int, floor: int) -> int:
    """The smallest integer above `floor` whose low `bits` are `low_bits`.

    For numbers of which a whole range may be lost: what is not just late is taken for new.
    """
    return floor + 1 + (low_bits - floor - 1) % (1 << bits)


class ReceivedWindow:
    """Which of the last `span` numbers have arrived: tells a duplicate from a late packet."""

    __slots__ = ("_seen", "highest", "span")

    def __init__(self, span: int = 1024) -> None:
        self.span = span
        self.highest = -1
        self._seen = 0  # bit i: number (highest - i) has arrived

    def accept(self, number: int) -> bool:
        """True the first time a number arrives; False for a duplicate or one older than the window."""
        ahead = number - self.highest
        if ahead > 0:
            self._seen = (self._seen << ahead | 1) & ((1 << self.span) - 1) if ahead < self.span else 1
            self.highest = number
            return True
        bit = 1 << -ahead
        if -ahead >= self.span or self._seen & bit:
            return False
        self._seen |= bit
        return True

    def below(self, number: int, bits: int) -> bytes:
        """Which of the `bits` numbers before the highest have been accepted: bit 0 is number - 1.

        Little-endian; empty if all have. Numbers below 0 count as accepted.
        """
        assert number == self.highest, "the window is told relative to its highest number"
        existing = min(bits, number)
        seen = self._seen >> 1 & ((1 << bits) - 1) | ((1 << bits) - 1 >> existing << existing)
        return b"" if seen == (1 << bits) - 1 else seen.to_bytes(bits // 8, "little")

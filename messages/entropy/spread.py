"""How probable a residual is, given about how large residuals are here: a bell with heavy tails.

Student's distribution with two degrees of freedom, whose sum below x is (1 + x / sqrt(2 + x^2)) / 2: right
for values whose scale is itself uncertain, and exact in integers. Measured on recorded joint motion, two
degrees cost the least of 1 to 6, and 10 % less than the two-sided geometric distribution.
"""

from __future__ import annotations

from math import isqrt

from messages.entropy.range_coder import RangeDecoder, RangeEncoder

SCALE_ONE = 16  # a scale is given in sixteenths of a step
NEAR = (1 << 15) - 1  # residuals of greater magnitude are escaped
_HALF_BITS = 30
_FLOOR = 1 << 8  # of each value, so that nothing is impossible: 23 bits for the least expected
_ESCAPE_TOTAL = 1 << 12  # one in so many is escaped, where that can happen at all


def _edge(doubled: int, square: int) -> int:
    """The sum below doubled / 2, less a half, in units of 2^-31; square: of the scale in sixteenths."""
    part = 32 * doubled * doubled
    root = isqrt((part << 2 * _HALF_BITS) // (square + part))
    return root if doubled >= 0 else -root


class Spread:
    """The distribution of residuals between two bounds (both included) around a scale of at least 1/16."""

    __slots__ = ("_escapes", "_first", "_high", "_low", "_scale", "_square", "_total")

    def __init__(self, scale: int, low: int, high: int) -> None:
        self._escapes = low < -NEAR or high > NEAR
        self._low, self._high = max(low, -NEAR), min(high, NEAR)
        self._scale, self._square = scale, scale * scale
        self._first = _edge(2 * self._low - 1, self._square)
        self._total = self._below(self._high + 1)

    def encode(self, coder: RangeEncoder, residual: int) -> bool:
        """Code a residual; False, and only that it is not here, where it must be sent otherwise."""
        if self._escapes:
            is_near = self._low <= residual <= self._high
            coder.encode(*((0, _ESCAPE_TOTAL - 1) if is_near else (_ESCAPE_TOTAL - 1, 1)), _ESCAPE_TOTAL)
            if not is_near:
                return False
        below = self._below(residual)
        coder.encode(below, self._below(residual + 1) - below, self._total)
        return True

    def decode(self, coder: RangeDecoder) -> int | None:
        """The next residual; None where it is sent otherwise."""
        if self._escapes:
            share = coder.share(_ESCAPE_TOTAL)
            if share >= _ESCAPE_TOTAL - 1:
                coder.take(_ESCAPE_TOTAL - 1, 1)
                return None
            coder.take(0, _ESCAPE_TOTAL - 1)
        share = coder.share(self._total)
        low, high = self._bracket(share)
        while high - low > 1:
            middle = (low + high) // 2
            if self._below(middle) <= share:
                low = middle
            else:
                high = middle
        below = self._below(low)
        coder.take(below, self._below(low + 1) - below)
        return low

    def _below(self, residual: int) -> int:
        """What all lesser residuals have of the total."""
        return _edge(2 * residual - 1, self._square) - self._first + (residual - self._low) * _FLOOR

    def _bracket(self, share: int) -> tuple[int, int]:
        """A residual at or below the share's, and one above it, found in growing steps from the middle."""
        low = high = max(self._low, min(self._high, 0))
        step = 1 + (self._scale >> 5)
        while low > self._low and self._below(low) > share:
            high = low
            low, step = max(self._low, low - step), 2 * step
        while high <= self._high and self._below(high) <= share:
            low = high
            high, step = min(self._high + 1, high + step), 2 * step
        return low, high

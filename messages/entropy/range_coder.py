"""A range coder in integers: symbols by their share of a total, as close to their information as matters.

The code is a number in [0, 1), its digits sent highest first; each symbol narrows an interval in which it
lies. Source: Martin, "Range encoding" (1979); the carry is propagated into what was written.
"""

from __future__ import annotations

_WINDOW_BITS = 64
_DIGIT_BITS = 16
_MASK = (1 << _WINDOW_BITS) - 1
_LEAST_RANGE = 1 << (_WINDOW_BITS - _DIGIT_BITS)
_DIGIT_MASK = (1 << _DIGIT_BITS) - 1
MAX_TOTAL = 1 << 40  # a symbol's share is then exact to 2^-8 of itself at worst


class RangeEncoder:
    """Builds one code."""

    def __init__(self) -> None:
        self._low = 0
        self._range = 1 << _WINDOW_BITS
        self._digits: list[int] = []

    def encode(self, below: int, share: int, total: int) -> None:
        """A symbol that has `share` of `total`, above `below` of the others'."""
        unit = self._range // total
        self._low += unit * below
        self._range = unit * share
        if self._low > _MASK:
            self._carry()
        while self._range < _LEAST_RANGE:
            self._digits.append(self._low >> (_WINDOW_BITS - _DIGIT_BITS))
            self._low = self._low << _DIGIT_BITS & _MASK
            self._range <<= _DIGIT_BITS

    def encode_uniform(self, value: int, count: int) -> None:
        """One of `count` equally likely values."""
        while count > MAX_TOTAL:
            value, low = divmod(value, 1 << 32)
            self.encode(low, 1, 1 << 32)
            count = (count + (1 << 32) - 1) >> 32
        self.encode(value, 1, count)

    def finish(self) -> tuple[int, int]:
        """The code, its first digit highest, and its bits: whatever bits follow, it decodes the same."""
        value, width = _last_digits(self._low, self._range)
        if value >> width:
            value &= (1 << width) - 1
            self._carry()
        digits = 0
        if self._digits:
            digits = int.from_bytes(b"".join(d.to_bytes(2, "big") for d in self._digits), "big")
        return digits << width | value, _DIGIT_BITS * len(self._digits) + width

    def finish_bytes(self) -> bytes:
        """The code as the fewest bytes, after which zeros are read: for a code that ends a datagram."""
        value, width = _last_digits(self._low, self._range, ends_in_zeros=True)
        if value >> width:
            value &= (1 << width) - 1
            self._carry()
        return b"".join(d.to_bytes(2, "big") for d in self._digits) + value.to_bytes(width // 8, "big")

    def _carry(self) -> None:
        self._low &= _MASK
        at = len(self._digits) - 1
        while self._digits[at] == _DIGIT_MASK:
            self._digits[at] = 0
            at -= 1
        self._digits[at] += 1


class RangeDecoder:
    """Reads one code from `length` bits of `bits`, the first highest; zeros follow them.

    Every code means something: one that no encoder writes is read as the nearest that one might.
    """

    def __init__(self, bits: int, length: int) -> None:
        self._bits = bits
        self._left = length - _WINDOW_BITS  # bits of it below the window; zeros follow if negative
        self._code = (bits >> self._left if self._left >= 0 else bits << -self._left) & _MASK
        self._low = 0
        self._range = 1 << _WINDOW_BITS
        self._taken = 0
        self._unit = 1

    def share(self, total: int) -> int:
        """Where in the total the next symbol lies; call `take` with the symbol that is there."""
        self._unit = self._range // total
        return min(self._code // self._unit, total - 1)

    def take(self, below: int, share: int) -> None:
        """Go on after the symbol."""
        self._code -= self._unit * below
        self._low = self._low + self._unit * below & _MASK
        self._range = self._unit * share
        if self._code >= self._range:
            self._code = self._range - 1
        while self._range < _LEAST_RANGE:
            self._left -= _DIGIT_BITS
            digit = self._bits >> self._left if self._left >= 0 else self._bits << -self._left
            self._code = self._code << _DIGIT_BITS | digit & _DIGIT_MASK
            self._low = self._low << _DIGIT_BITS & _MASK
            self._range <<= _DIGIT_BITS
            self._taken += _DIGIT_BITS

    def decode_uniform(self, count: int) -> int:
        """One of `count` equally likely values; of more than 2^40, damaged bits may make it one beyond."""
        value, shift = 0, 0
        while count > MAX_TOTAL:
            low = self.share(1 << 32)
            self.take(low, 1)
            value, shift = value | low << shift, shift + 32
            count = (count + (1 << 32) - 1) >> 32
        high = self.share(count)
        self.take(high, 1)
        return value | high << shift

    def taken_bits(self) -> int:
        """How many bits an encoder has written for what was decoded."""
        return self._taken + _last_digits(self._low, self._range)[1]

    def is_finished(self, size: int) -> bool:
        """Whether `finish_bytes` of what was decoded gives just the bytes that were, `size` of them."""
        value, width = _last_digits(self._low, self._range, ends_in_zeros=True)
        is_exact = self._low + self._code == value << _WINDOW_BITS - width
        return is_exact and 8 * size == self._taken + width


def _last_digits(low: int, extent: int, ends_in_zeros: bool = False) -> tuple[int, int]:
    """The fewest bits that leave no doubt of an interval in the window, and how many they are.

    ends_in_zeros: only zeros follow, and the bits are whole bytes; else anything may follow.
    """
    width = 0 if ends_in_zeros else max(0, _WINDOW_BITS + 1 - extent.bit_length())
    while True:
        shift = _WINDOW_BITS - width
        value = -(-low >> shift)
        end = value << shift if ends_in_zeros else (value + 1 << shift) - 1
        if end < low + extent:
            return value, width
        width += 8 if ends_in_zeros else 1

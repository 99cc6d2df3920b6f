"""Mixed radix: several small integers as one, so that bits are rounded up once and not for each."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

_AT_ONCE = 16  # digits that are taken off one by one; longer lists are halved, as long divisions are slow


@lru_cache(maxsize=4096)
def power(count: int, digits: int) -> int:
    """How many lists of so many digits there are."""
    return int(count**digits)


def join(digits: Sequence[int], count: int) -> int:
    """Digits of 0 to count - 1 as one integer, the first digit lowest."""
    if len(digits) <= _AT_ONCE:
        joined = 0
        for digit in reversed(digits):
            joined = joined * count + digit
        return joined
    half = len(digits) // 2
    return join(digits[:half], count) + join(digits[half:], count) * power(count, half)


def split(joined: int, count: int, length: int) -> list[int]:
    """Undo `join`. The last digit is 0 to count - 1 only where joined < count ** length."""
    if length <= _AT_ONCE:
        digits = []
        for _ in range(length):
            joined, digit = divmod(joined, count)
            digits.append(digit)
        return digits
    half = length // 2
    above, below = divmod(joined, power(count, half))
    return split(below, count, half) + split(above, count, length - half)

"""Probabilities for the binary coder: adaptive contexts, mixed in the logistic domain.

Every table is made with whole numbers, so that all machines hold the same one. The logistic domain has
256 steps to a nat. Source: the mixing networks of M. Mahoney's PAQ family.
"""

from __future__ import annotations

from bisect import bisect_left
from typing import NamedTuple

from .compiled import Ints, inlined, ints

NAT = 256  # steps of the logistic domain to one nat
MOST_LOGIT = 2815  # 11 nats: a probability of 1.1 / 65536
MIXER_ONE = 1 << 16  # a weight of 1
COUNT_BITS = 10  # a context slot is probability << 10 | count, the probability in 1/2**22
_COUNT_MASK = (1 << COUNT_BITS) - 1
FRESH = 1 << 31  # a slot that has seen nothing: one half, count 0
MOST_COUNT = 255
_GUARD_BITS = 96  # of the fixed-point exponentials below


def _powers() -> list[int]:
    """exp(i / 256) for i = 0..2815, in fixed point."""
    one = 1 << _GUARD_BITS
    root, term, divisor = one, one, 0
    while term:
        divisor += 1
        term = term // NAT // divisor
        root += term
    powers = [one]
    for _ in range(MOST_LOGIT):
        powers.append(powers[-1] * root >> _GUARD_BITS)
    return powers


def _squash_table(powers: list[int]) -> Ints:
    """65536 / (1 + exp(-i / 256)) for i = -2815..2815, rounded."""
    one = powers[0]
    rising = [((power << 17) // (one + power) + 1) >> 1 for power in powers]
    return ints([65536 - p for p in rising[:0:-1]] + rising)


def _stretch_table(powers: list[int]) -> Ints:
    """The logit of each probability of 12 bits, taken in the middle of its step."""
    odds = [((8192 - odd) * powers[0], odd) for odd in range(1, 4096, 2)]  # of 1 - p, p below one half
    rising = [-bisect_left(powers, scaled // odd) for scaled, odd in odds]
    return ints(rising + [-logit for logit in reversed(rising)])


_POWERS = _powers()
SQUASH = _squash_table(_POWERS)
STRETCH = _stretch_table(_POWERS)
CONFIDENCE = ints([0] + [MIXER_ONE * (2 * n + 1) // (2 * n + 4) for n in range(1, MOST_COUNT + 1)])
RATE = ints([(1 << 16) * 2 // (2 * count + 3) for count in range(MOST_COUNT + 1)])  # 1 / (count + 1.5)


@inlined
def squash(squash_table: Ints, logit: int) -> int:
    """The probability (1/65536) of a logit, which is first held within ±11 nats."""
    return int(squash_table[min(max(logit, -MOST_LOGIT), MOST_LOGIT) + MOST_LOGIT])


@inlined
def logit_of(stretch_table: Ints, slot: int) -> int:
    """The logit of a context slot."""
    return int(stretch_table[slot >> 20])


class Tables(NamedTuple):
    """What every model reads and none writes."""

    squash: Ints
    stretch: Ints
    rate: Ints
    confidence: Ints


TABLES = Tables(SQUASH, STRETCH, RATE, CONFIDENCE)


@inlined
def confident_logit(tables: Tables, slot: int) -> int:
    """The logit of a context slot, nearer to nothing the fewer bits the slot has seen; 0 when fresh."""
    return int(tables.stretch[slot >> 20] * tables.confidence[slot & _COUNT_MASK] >> 16)


@inlined
def learned(rate_table: Ints, slot: int, bit: int, limit: int) -> int:
    """The slot after one more bit: a running mean of the first `limit` bits, a decaying one after."""
    count = slot & _COUNT_MASK
    p = slot >> COUNT_BITS
    p += (((bit << 22) - p) * rate_table[count]) >> 16
    p = min(max(p, 64), (1 << 22) - 64)
    return int(p << COUNT_BITS | (count + 1 if count < limit else count))


@inlined
def mixed(weights: Ints, at: int, inputs: Ints, count: int) -> int:
    """The weighted sum of `count` logits, with the set of weights that starts at `at`."""
    total = 0
    for i in range(count):
        total += weights[at + i] * inputs[i]
    return total >> 16


@inlined
def train(weights: Ints, at: int, inputs: Ints, count: int, error: int, shift: int) -> None:
    """Move the weights down the gradient of coding cost; `error` is (bit << 16) - p."""
    for i in range(count):
        weights[at + i] += (inputs[i] * error + (1 << (shift - 1))) >> shift

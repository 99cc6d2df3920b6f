"""Lanes that move together: each foretold from up to two before it, by how they moved in shared history.

The joints of a gait, of a hand that closes, of an arm on its way are many lanes and few motions. All in
integers of at most 53 bits, so that the two ends agree to the bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import isqrt

import numpy as np
from numpy.typing import NDArray

from messages.delta.lanes import Lane, LaneKind
from messages.delta.sample import HISTORY, References

_MAX_LANES = 128  # that take part: the work grows with their square
_MOVE_BITS = 11  # of a move in history; what is larger is told coarser
_ROUNDING = HISTORY  # squared steps that a lane strays over a history without moving
_EXPLAINED = 16  # a lane leans if all but 1/16 of how it moved is explained
_SLOPE_BITS = 16
_LEAST_SCALE = 12
_ERROR_SQUARED = 100  # a scale of 10 for an error of one step: half to twice that matters by 2 %

Integers = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Leaning:
    """How one lane follows others: slopes in 2^-16, of steps for steps.

    supports: (lane, slope). usual: how far the first of them moved in history, squared; left: what of this
    lane's moves is not explained, squared; both means, in steps.
    """

    supports: tuple[tuple[int, int], ...]
    usual: int
    left: int

    def foretell(self, moved: Sequence[int]) -> tuple[int, int]:
        """How far the lane has moved from its reference, from the others' moves; and the scale of its error.

        What is not explained grows with how much further the first support has moved than it used to.
        """
        total = sum(slope * moved[at] for at, slope in self.supports)
        error = isqrt(_ERROR_SQUARED * self.left)
        error += error * abs(moved[self.supports[0][0]]) // (1 + isqrt(self.usual))
        return total + (1 << _SLOPE_BITS - 1) >> _SLOPE_BITS, _LEAST_SCALE + error


def leanings(lanes: Sequence[Lane], known: References) -> dict[int, Leaning]:
    """By lane, those that others explain. Only numbers whose guard was the same in all that is known."""
    places = _moving(lanes, known)
    if len(places) < 2 or len(known.history) < 3:
        return {}
    moves = [[s.lanes[at] - known.reference.lanes[at] for at in places] for _, s in known.history]
    shifts = [max(0, max(map(abs, column)).bit_length() - _MOVE_BITS) for column in zip(*moves, strict=True)]
    scaled = np.array([[move >> s for move, s in zip(row, shifts, strict=True)] for row in moves], np.int64)
    together = scaled.T @ scaled
    return _explained(together, places, shifts, len(moves))


def _moving(lanes: Sequence[Lane], known: References) -> list[int]:
    before = known.reference.lanes
    samples = [sample.lanes for _, sample in known.history]
    steady = {
        g for g in {lane.guard for lane in lanes} if g is None or all(s[g] == before[g] for s in samples)
    }
    return [
        at
        for at, lane in enumerate(lanes)
        if lane.kind is LaneKind.NUMBER and lane.guard in steady and any(s[at] != before[at] for s in samples)
    ][:_MAX_LANES]


def _explained(
    together: Integers, places: Sequence[int], shifts: Sequence[int], count: int
) -> dict[int, Leaning]:
    """Least squares on the best lane before, then on the best for what that leaves."""
    own = together.diagonal() + _ROUNDING
    earlier = np.tri(len(places), k=-1, dtype=np.int64)
    first = (together * together // own * earlier).argmax(axis=1)
    rows = together[first]  # of each lane's first support
    own_first = own[first][:, None]
    by_first = np.take_along_axis(together, first[:, None], axis=1)
    apart = together - by_first * rows // own_first
    own_apart = np.maximum(_ROUNDING, own - rows * rows // own_first)
    gains = apart * apart // own_apart * earlier
    np.put_along_axis(gains, first[:, None], 0, axis=1)
    second = gains.argmax(axis=1)
    found = {}
    for j in range(1, len(places)):
        k, m = int(first[j]), int(second[j])
        c, own_k, own_j = int(together[j, k]), int(own[k]), int(own[j])
        left = own_j - c * c // own_k - int(gains[j, m])
        if left * _EXPLAINED > own_j:
            continue
        slope_m = (int(apart[j, m]) << _SLOPE_BITS) // int(own_apart[j, m]) if gains[j, m] else 0
        slope_k = ((c << _SLOPE_BITS) - slope_m * int(together[k, m])) // own_k
        supports = [(places[k], _unscaled(slope_k, shifts[j] - shifts[k]))]
        if slope_m:
            supports.append((places[m], _unscaled(slope_m, shifts[j] - shifts[m])))
        usual = (own_k << 2 * shifts[k]) // count
        found[places[j]] = Leaning(tuple(supports), usual, (max(0, left) << 2 * shifts[j]) // count)
    return found


def _unscaled(slope: int, shift: int) -> int:
    return slope << shift if shift >= 0 else slope >> -shift

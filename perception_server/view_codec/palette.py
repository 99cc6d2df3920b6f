"""Codes as ranks among those in use.

A structured-light or stereo sensor measures whole disparities, so its depths lie on few values whose
spacing grows with the square of the distance. Ranks close those gaps, and since disparity is linear over
a plane, they also make planes of walls.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .errors import DecodeError
from .quantisation import HOLE, Codes


def used_codes(cells: Codes) -> NDArray[np.bool_] | None:
    """(levels,) which codes occur, where sending that pays; None where it does not.

    A gap between two populated codes saves log2(gap) bits in each of their cells; a gap in a thin tail
    says nothing about the sensor and only bends the geometry. So a gap counts by the smaller of its two
    populations, and all together must outweigh the set itself.
    """
    population = np.bincount(cells.codes[cells.valid], minlength=cells.levels)
    used = np.flatnonzero(population)
    share = len(used) / max(cells.levels, 1)
    if not 0 < share < 1 or len(used) < 2:
        return None
    counts = population[used]
    saved_bits = float((np.log2(np.diff(used)) * np.minimum(counts[1:], counts[:-1])).sum())
    set_bits = -cells.levels * (share * np.log2(share) + (1 - share) * np.log2(1 - share))
    return population > 0 if saved_bits > set_bits + 16 else None


def to_ranks(cells: Codes, used: NDArray[np.bool_]) -> Codes:
    """Each code's rank among the used."""
    rank = np.cumsum(used) - 1
    return Codes(np.where(cells.valid, rank[cells.codes], HOLE), int(used.sum()))


def from_ranks(ranks: NDArray[np.int64], used: NDArray[np.bool_]) -> NDArray[np.int64]:
    """The codes of ranks. Raises DecodeError for a rank that no used code has."""
    codes = np.flatnonzero(used)
    if ranks.size and int(ranks.max()) >= len(codes):
        raise DecodeError(f"rank {int(ranks.max())} is beyond a palette of {len(codes)} codes")
    return np.where(ranks == HOLE, HOLE, codes[ranks]) if len(codes) else ranks

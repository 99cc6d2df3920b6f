"""Metres to whole codes with a bounded error, and back.

Source of the lattice: oh-distro's maps (a range divided into 2**bits - 2 steps, the top code for holes).
Unlike there, the farthest code is never a hole's, and flat and empty maps are maps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .errors import EncodeError
from .map_header import MAX_LEVELS

LEAST_BITS = 2
MOST_BITS = 16
HOLE = -1
_PHASES = 64  # places of the lattice that are tried, in a step


@dataclass(frozen=True, slots=True, eq=False)
class Lattice:
    """Code k stands for origin_m + k * step_m; both are float32 values, so that they travel exactly."""

    origin_m: float
    step_m: float
    levels: int


@dataclass(frozen=True, slots=True, eq=False)
class Codes:
    """A quantised map. codes: (rows, columns) int64, 0..levels - 1, HOLE where nothing was measured."""

    codes: NDArray[np.int64]
    levels: int

    @property
    def valid(self) -> NDArray[np.bool_]:
        """(rows, columns), where a code stands."""
        return np.not_equal(self.codes, HOLE)


def lattice_for(values_m: NDArray[np.float32], *, max_error_m: float | None, bits: int | None) -> Lattice:
    """The coarsest lattice that keeps `max_error_m`, or the finest that `bits` can number.

    values_m: (N,) float32, finite; may be empty. Raises EncodeError if no lattice does.
    """
    if not len(values_m):
        return Lattice(0.0, 0.0, 0)
    low, high = float(values_m.min()), float(values_m.max())
    if low == high:
        return Lattice(low, 0.0, 1)
    if bits is not None:
        steps = 2**bits - 2
        step = np.float32((high - low) / steps)
        if float(step) * steps < high - low:
            step = np.nextafter(step, np.float32(np.inf))
        return Lattice(low, float(step), steps + 1)
    assert max_error_m is not None
    rounding = float(np.spacing(np.float32(max(abs(low), abs(high)))))  # of the decoded float32
    step = np.nextafter(np.float32(2 * (max_error_m - rounding)), np.float32(0))
    origin = _centred_origin(values_m, float(step)) if step > 0 else low
    levels = int((high - origin) / float(step) + 0.5) + 1 if step > 0 else MAX_LEVELS + 1
    if levels > MAX_LEVELS:
        raise EncodeError(
            f"max_error_m = {max_error_m} over {high - low:.3f} m of range takes {levels} codes; "
            f"the most is {MAX_LEVELS}"
        )
    return Lattice(origin, float(step), levels)


def _centred_origin(values_m: NDArray[np.float32], step_m: float) -> float:
    """The origin, within half a step of the lowest value, that moves the cells least, by their squares.

    What is flat, as floors are, then lies on a code, and not between two of which noise would pick one,
    nor beside one by the same error everywhere. Counted in whole numbers, so that it is the same anywhere.
    """
    steps = (values_m.astype(np.float64) - float(values_m.min())) / step_m
    place = np.floor((steps - np.floor(steps)) * _PHASES).astype(np.int64)
    population = np.bincount(np.minimum(place, _PHASES - 1), minlength=_PHASES)
    off = (np.arange(_PHASES)[:, None] - np.arange(_PHASES) + _PHASES // 2) % _PHASES - _PHASES // 2
    moved = np.square(off) @ population
    phases = sorted(range(_PHASES // 2 + 1 - _PHASES, _PHASES // 2), key=abs)
    phase = min(phases, key=lambda phase: int(moved[phase]))
    return float(np.float32(float(values_m.min()) + phase / _PHASES * step_m))


def quantise(values_m: NDArray[np.float32], lattice: Lattice) -> Codes:
    """values_m: (rows, columns) float32; what is not finite is a hole."""
    valid = np.isfinite(values_m)
    codes = np.full(values_m.shape, HOLE, np.int64)
    if lattice.levels <= 1:
        codes[valid] = 0
        return Codes(codes, lattice.levels)
    steps = (values_m[valid].astype(np.float64) - lattice.origin_m) / lattice.step_m
    codes[valid] = np.clip(np.floor(steps + 0.5), 0, lattice.levels - 1)
    return Codes(codes, int(codes.max()) + 1)


def dequantise(codes: NDArray[np.int64], origin_m: float, step_m: float) -> NDArray[np.float32]:
    """(rows, columns) float32 metres, NaN in holes; one multiplication and one addition in doubles."""
    values = (origin_m + codes * step_m).astype(np.float32)
    values[codes == HOLE] = np.nan
    return values

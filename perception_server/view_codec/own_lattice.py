"""The lattice on which points lie already, such as the centres of voxels.

Any other lattice would send where in each voxel its point fell, which says nothing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_SLACK = 4  # roundings to float32 by which a point may miss its place: its own, the origin's, the step's
_STEPS_OVER_SLACK = 16  # below, any points lie on a lattice within the slack
_MOST_DIVISIONS = 32  # Euclid's; each at least halves what is left


def slack_m(points: NDArray[np.float64]) -> float:
    """How far a point may be from its place on a lattice by rounding alone."""
    return _SLACK * float(np.spacing(np.float32(np.abs(points).max(initial=0.0))))


def own_step_m(points: NDArray[np.float64], least_m: float) -> float | None:
    """The largest step, the same for all axes, of which all coordinates are multiples from their lowest.

    points: (N, 3) metres, N at least 1. None if that is below least_m, or no more than rounding.
    """
    slack = slack_m(points)
    steps = np.concatenate([np.diff(np.sort(axis)) for axis in points.T])
    apart = steps[steps > slack]
    if not len(apart):
        return None
    step = float(apart.min())
    for _ in range(_MOST_DIVISIONS):
        if step < max(least_m, _STEPS_OVER_SLACK * slack):
            return None
        count = np.rint(apart / step)
        left = np.abs(apart - count * step)
        off = left[left > slack * (1 + count)]
        if not len(off):
            return float(steps.sum() / np.rint(steps / step).sum())  # the mean: one step has its rounding
        step = float(off.min())
    return None

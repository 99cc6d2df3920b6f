"""What a cloud is to the codecs: the rows of an (N, 3) array that have a place."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import EncodeError

MAX_COORDINATE_M = 1e30  # leaves room for sums and steps within float32


def finite_points(points: ArrayLike) -> NDArray[np.float64]:
    """The rows without NaN and infinity, which sensors give where nothing returned (REP-117).

    Raises EncodeError for another shape and for coordinates beyond MAX_COORDINATE_M.
    """
    array = np.asarray(points, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != 3:
        raise EncodeError(f"points of shape {array.shape} must be (N, 3)")
    known = array[np.isfinite(array).all(axis=1)]
    largest_m = float(np.abs(known).max(initial=0.0))
    if largest_m > MAX_COORDINATE_M:
        raise EncodeError(f"a coordinate of {largest_m:g} m is beyond {MAX_COORDINATE_M:g} m")
    return known

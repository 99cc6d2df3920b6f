"""What may be done to a map besides quantising it, always told in its header.

Denoising is the sender's and changes values; closing is the reader's and only adds cells, so that it
costs no bits and what was measured stays known.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_RADIUS = 2  # cells
_SPREAD_CELLS = 1.5  # standard deviation over distance
_SPREAD_M = 0.025  # and over height: three times a good lidar's noise, a third of a kerb
_MOST_GAP = 2  # cells
_MOST_STEP_M = 0.1  # across a gap; beyond it there may be an edge, which nobody shall invent a slope for


def denoised(values_m: NDArray[np.float32]) -> NDArray[np.float32]:
    """A bilateral filter over 5x5 cells that leaves holes holes and edges edges.

    values_m: (rows, columns) float32, NaN in holes. Source: Tomasi and Manduchi, ICCV 1998.
    """
    rows, columns = values_m.shape
    padded = np.full((rows + 2 * _RADIUS, columns + 2 * _RADIUS), np.nan, np.float32)
    padded[_RADIUS:-_RADIUS, _RADIUS:-_RADIUS] = values_m
    total = np.zeros(values_m.shape, np.float32)
    weights = np.zeros(values_m.shape, np.float32)
    for down in range(2 * _RADIUS + 1):
        for across in range(2 * _RADIUS + 1):
            off = padded[down : down + rows, across : across + columns] - values_m
            squared = ((down - _RADIUS) ** 2 + (across - _RADIUS) ** 2) / _SPREAD_CELLS**2
            weight = np.exp(np.float32(-0.5) * (np.square(off / np.float32(_SPREAD_M)) + np.float32(squared)))
            known = ~np.isnan(off)
            weights += np.where(known, weight, 0)
            total += np.where(known, weight * off, 0)
    return (values_m + total / np.where(weights > 0, weights, 1)).astype(np.float32)


def closed(values_m: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Fill holes of one or two cells between two measured ones of a row or a column.

    Only where the two differ by at most 0.1 m; on the line between them, and on the mean of both lines
    where a row and a column cross. Returns the map and (rows, columns), which cells were filled.
    """
    across, has_across = _bridged(values_m)
    down, has_down = _bridged(values_m.T)
    count = has_across.astype(np.float64) + has_down.T
    filled = count > 0
    lines = (across + down.T) / np.where(filled, count, 1)
    return np.where(filled, lines.astype(np.float32), values_m), filled


def _bridged(values_m: NDArray[np.float32]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Heights on the lines over gaps along the rows, 0 elsewhere, and where they are."""
    columns = values_m.shape[1]
    heights = np.zeros(values_m.shape, np.float64)
    bridged = np.zeros(values_m.shape, np.bool_)
    for gap in range(1, min(_MOST_GAP, columns - 2) + 1):
        left = values_m[:, : columns - gap - 1].astype(np.float64)
        right = values_m[:, gap + 1 :].astype(np.float64)
        is_gap = np.abs(right - left) <= _MOST_STEP_M  # False beside a hole
        for k in range(1, gap + 1):
            is_gap &= np.isnan(values_m[:, k : columns - gap - 1 + k])
        for k in range(1, gap + 1):
            here = slice(k, columns - gap - 1 + k)
            line = left + (right - left) * (k / (gap + 1))
            heights[:, here] = np.where(is_gap, line, heights[:, here])
            bridged[:, here] |= is_gap
    return heights, bridged

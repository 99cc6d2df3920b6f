"""What may be done to a map besides quantising it, always told in its header.

Denoising is the sender's and changes values; the reader then smooths the steps that quantising put into
what was smooth. Closing is the reader's and only adds cells, so that it costs no bits and what was measured
stays known. What readers do is made of +, -, * and / on doubles in a written order.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_RADIUS = 2  # cells
_SPREAD_CELLS = 1.5  # standard deviation over distance
_SPREAD_M = 0.025  # and over height: three times a good lidar's noise, a third of a kerb
_SMOOTHING_PASSES = 4
_HALF_OF_THE_NEIGHBOURS = [(0, 1), (0, 2)] + [(down, across) for down in (1, 2) for across in range(-2, 3)]
_REACH_STEPS = 1.5  # quantisation steps; neighbours farther away are across an edge
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


def smoothed(values_m: NDArray[np.float32], step_m: float) -> NDArray[np.float32]:
    """Take the quantisation's terraces out of a map that was smooth before.

    Each pass moves every cell to the mean of its 5x5 neighbours, weighted by 1 - (difference / reach)², but
    never out of the half step around its code within which it was. Opposite neighbours count together or
    not at all, so that a slope stays one up to its border.
    """
    centre = values_m.astype(np.float64)
    half_m = 0.5 * step_m
    result = centre
    for _ in range(_SMOOTHING_PASSES if step_m > 0 else 0):
        moved = _smoothed_once(result, _REACH_STEPS * step_m)
        result = np.minimum(np.maximum(moved, centre - half_m), centre + half_m)
    return result.astype(np.float32)


def _smoothed_once(values_m: NDArray[np.float64], reach_m: float) -> NDArray[np.float64]:
    rows, columns = values_m.shape
    padded = np.full((rows + 2 * _RADIUS, columns + 2 * _RADIUS), np.nan)
    padded[_RADIUS:-_RADIUS, _RADIUS:-_RADIUS] = values_m

    def to_neighbour(down: int, across: int) -> NDArray[np.float64]:
        top, left = _RADIUS + down, _RADIUS + across
        return padded[top : top + rows, left : left + columns] - values_m

    total, weights = np.zeros(values_m.shape), np.ones(values_m.shape)
    for down, across in _HALF_OF_THE_NEIGHBOURS:
        one, other = to_neighbour(down, across), to_neighbour(-down, -across)
        share, other_share = one / reach_m, other / reach_m
        weight = np.maximum(1.0 - share * share, 0.0) * np.maximum(1.0 - other_share * other_share, 0.0)
        known = ~np.isnan(weight)
        weights += np.where(known, 2.0 * weight, 0.0)
        total += np.where(known, weight * (one + other), 0.0)
    return values_m + total / weights


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

"""Ground seen beneath something: whether what stands over it is higher, no return can tell.

A map from above shows the uppermost surface. A beam that comes in low passes under a plank that leans away
from the scanner, or under a tilted block, and meets the floor below a top that no beam met. Such a return
gives itself away: on its way it went below something that was seen nearer to the sensor.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from perception_server.compiled import compiled
from perception_server.frames import FloatArray

OF_CELL_M = 0.05  # a return within this of its cell's height is one of those that it was read from
REACH_M = 0.6  # how far from where it was seen something may cover the ground
CLEAR_M = 0.05  # below it by so much: more than noise and the slope of one cell


@compiled
def drop_what_is_beneath(
    points: NDArray[np.float32],
    lowest: NDArray[np.int32],
    heights: NDArray[np.float32],
    tops: FloatArray,
    origins: NDArray[np.float32],
    stops: NDArray[np.int64],
    min_x: float,
    min_y: float,
    resolution: float,
) -> None:
    """Make holes in heights (rows, columns) of cells whose lowest return came in beneath something.

    points: (N, 3); lowest: (cells,) the index of each one's lowest return. Cells that were read from returns
    above that one stay. tops: (rows, columns), the height of each one's highest return.
    origins: (S, 3) where each scan was taken from; stops: (S,) where its points end.
    """
    for row in range(heights.shape[0]):
        for column in range(heights.shape[1]):
            i = lowest[row * heights.shape[1] + column]
            if np.isnan(heights[row, column]) or points[i, 2] < heights[row, column] - OF_CELL_M:
                continue
            scan = np.searchsorted(stops, i, side="right")
            if _passes_under(points[i], origins[scan], tops, min_x, min_y, resolution):
                heights[row, column] = np.nan


@compiled
def _passes_under(
    point: NDArray[np.float32],
    origin: NDArray[np.float32],
    tops: FloatArray,
    min_x: float,
    min_y: float,
    resolution: float,
) -> bool:
    """Whether the beam from origin to point goes below a return of another cell, within reach of its end."""
    x, y, z = origin[0] - point[0], origin[1] - point[1], origin[2] - point[2]
    distance = np.sqrt(x * x + y * y)
    if distance < resolution:
        return False
    step_x, step_y, rise = x / distance, y / distance, resolution * z / distance
    column0, row0 = (point[0] - min_x) / resolution, (point[1] - min_y) / resolution
    clear = point[2] + CLEAR_M
    for step in range(1, int(min(REACH_M, distance) / resolution) + 1):
        column, row = int(column0 + step * step_x), int(row0 + step * step_y)
        if not (0 <= row < tops.shape[0] and 0 <= column < tops.shape[1]):
            return False
        if tops[row, column] > clear + step * rise and (row != int(row0) or column != int(column0)):
            return True
    return False

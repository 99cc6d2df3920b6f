"""Fewer points: one of those in each voxel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from perception_server.compiled import compiled
from perception_server.frames import FloatArray


def resample(points_m: NDArray[np.float32], voxel_m: float) -> NDArray[np.float32]:
    """(M, 3): of each occupied voxel the point nearest to the mean of its points.

    A point that was measured, not the mean itself: what is sent lies where the sensor saw something.
    The voxels' grid passes through the frame's origin.
    """
    if len(points_m) == 0:
        return points_m
    keys = np.floor(points_m / np.float32(voxel_m)).astype(np.int64)
    keys -= keys.min(axis=0)
    spans = keys.max(axis=0) + 1
    flat = (keys[:, 0] * spans[1] + keys[:, 1]) * spans[2] + keys[:, 2]
    order = np.argsort(flat, kind="stable")
    ordered = flat[order]
    first = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
    grouped = points_m[order]
    return grouped[_nearest_to_mean(grouped, np.append(first, len(grouped)))]


@compiled
def _nearest_to_mean(points: NDArray[np.float32], first: NDArray[np.int64]) -> NDArray[np.int64]:
    chosen = np.empty(len(first) - 1, dtype=np.int64)
    for group in range(len(chosen)):
        begin, end = first[group], first[group + 1]
        mean: FloatArray = np.zeros(3)
        for i in range(begin, end):
            for axis in range(3):
                mean[axis] += points[i, axis] / (end - begin)
        best, nearest = begin, np.inf
        for i in range(begin, end):
            distance = 0.0
            for axis in range(3):
                distance += (points[i, axis] - mean[axis]) ** 2
            if distance < nearest:
                best, nearest = i, distance
        chosen[group] = best
    return chosen

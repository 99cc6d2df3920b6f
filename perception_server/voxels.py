"""Fewer points: one of those in each voxel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from perception_server.compiled import compiled
from perception_server.frames import FloatArray
from perception_server.view_codec import EncodeError

MAX_VOXELS = 1 << 19  # what the codecs of clouds and octrees take
_SLOTS = 1 << 21


def resample(points_m: NDArray[np.float32], voxel_m: float) -> NDArray[np.float32]:
    """(M, 3): of each occupied voxel the point nearest to the mean of its points.

    A point that was measured, not the mean itself: what is sent lies where the sensor saw something.
    The voxels' grid passes through the frame's origin. Raises EncodeError for more than MAX_VOXELS.
    """
    voxels = np.empty(len(points_m), dtype=np.int32)
    count = _number_voxels(
        points_m, voxel_m, np.full(_SLOTS, -1, np.int32), np.empty((MAX_VOXELS, 3)), voxels
    )
    if count < 0:
        raise EncodeError(f"more than {MAX_VOXELS} voxels of {voxel_m:g} m are occupied")
    return points_m[_nearest_to_mean(points_m, voxels, count)]


@compiled
def _number_voxels(
    points: NDArray[np.float32],
    voxel: float,
    slots: NDArray[np.int32],
    keys: FloatArray,
    voxels: NDArray[np.int32],
) -> int:
    """Number the occupied voxels in order of their first points; fills each point's; -1 = too many.

    slots: a hash table of voxels' numbers, open addressing. keys: of each voxel.
    """
    count = 0
    mask = len(slots) - 1
    per_m = 1.0 / voxel
    x = y = z = np.nan  # the voxel of the point before: a beam's neighbour is often in the same one
    number = np.int32(-1)
    for i in range(len(points)):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        if not (_holds(x, px, voxel) and _holds(y, py, voxel) and _holds(z, pz, voxel)):
            x, y, z = _key(px, voxel, per_m), _key(py, voxel, per_m), _key(pz, voxel, per_m)
            slot = (int(x) * 73856093 ^ int(y) * 19349669 ^ int(z) * 83492791) & mask
            while True:
                number = slots[slot]
                if number < 0:
                    if count == len(keys):
                        return -1
                    number = np.int32(count)
                    slots[slot] = number
                    keys[number, 0], keys[number, 1], keys[number, 2] = x, y, z
                    count += 1
                    break
                if keys[number, 0] == x and keys[number, 1] == y and keys[number, 2] == z:
                    break
                slot = (slot + 1) & mask
        voxels[i] = number
    return count


@compiled
def _holds(key: float, coordinate: float, voxel: float) -> bool:
    return bool(key * voxel <= coordinate < (key + 1.0) * voxel)


@compiled
def _key(coordinate: float, voxel: float, per_m: float) -> float:
    """The voxel that holds a coordinate, also where the product rounds across a border."""
    key = np.floor(coordinate * per_m)
    if key * voxel > coordinate:
        key -= 1.0
    if (key + 1.0) * voxel <= coordinate:
        key += 1.0
    return float(key)


@compiled
def _nearest_to_mean(points: NDArray[np.float32], voxels: NDArray[np.int32], count: int) -> NDArray[np.int64]:
    """(count,) index of the chosen point of each voxel."""
    means = np.zeros((count, 4))
    for i in range(len(points)):
        mean = means[voxels[i]]
        mean[0] += points[i, 0]
        mean[1] += points[i, 1]
        mean[2] += points[i, 2]
        mean[3] += 1
    chosen = np.zeros(count, dtype=np.int64)
    nearest = np.full(count, np.inf)
    for i in range(len(points)):
        number = voxels[i]
        mean = means[number]
        x = points[i, 0] - mean[0] / mean[3]
        y = points[i, 1] - mean[1] / mean[3]
        z = points[i, 2] - mean[2] / mean[3]
        squared = x * x + y * y + z * z
        if squared < nearest[number]:
            nearest[number] = squared
            chosen[number] = i
    return chosen

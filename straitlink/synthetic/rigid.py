"""Rigid transforms on stacks of matrices: (..., 4, 4) float64, named target_from_source."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.float64]


def rotation_about(axis: int, angle_rad: ArrayLike) -> FloatArray:
    """(..., 3, 3): right-handed rotations about x (0), y (1) or z (2) by each angle."""
    angle = np.asarray(angle_rad, dtype=np.float64)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    rotation = np.zeros((*angle.shape, 3, 3))
    rotation[..., axis, axis] = 1.0
    rotation[..., first, first] = rotation[..., second, second] = np.cos(angle)
    rotation[..., second, first] = np.sin(angle)
    rotation[..., first, second] = -rotation[..., second, first]
    return rotation


def rotation_from_rpy(roll_rad: ArrayLike, pitch_rad: ArrayLike, yaw_rad: ArrayLike) -> FloatArray:
    """(..., 3, 3): yaw about z, then pitch about the new y, then roll about the new x (REP-103)."""
    rotation: FloatArray = (
        rotation_about(2, yaw_rad) @ rotation_about(1, pitch_rad) @ rotation_about(0, roll_rad)
    )
    return rotation


def transform(rotation: FloatArray, translation_m: ArrayLike) -> FloatArray:
    """(..., 4, 4) from (..., 3, 3) and (..., 3), broadcast against each other."""
    translation = np.asarray(translation_m, dtype=np.float64)
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    matrix = np.zeros((*shape, 4, 4))
    matrix[..., :3, :3] = rotation
    matrix[..., :3, 3] = translation
    matrix[..., 3, 3] = 1.0
    return matrix


def inverse(matrix: FloatArray) -> FloatArray:
    """source_from_target for each target_from_source."""
    rotation = np.swapaxes(matrix[..., :3, :3], -1, -2)
    return transform(rotation, -(rotation @ matrix[..., :3, 3:])[..., 0])


def quaternion_from_rotation(rotation: FloatArray) -> FloatArray:
    """(..., 4) unit quaternions x, y, z, w with w >= 0, from (..., 3, 3).

    Four candidates, of which the one with the largest divisor is taken: exact also near half turns
    (Shepperd 1978).
    """
    r = rotation
    diagonal = np.einsum("...ii->...i", r)
    trace = diagonal.sum(axis=-1)
    candidates = np.empty((*r.shape[:-2], 4, 4))
    for i in range(3):
        candidates[..., i, i] = 1 + 2 * diagonal[..., i] - trace
    candidates[..., 3, 3] = 1 + trace
    for i, j in ((0, 1), (0, 2), (1, 2)):
        candidates[..., i, j] = candidates[..., j, i] = r[..., i, j] + r[..., j, i]
    for i, j, k in ((0, 2, 1), (1, 0, 2), (2, 1, 0)):
        candidates[..., i, 3] = candidates[..., 3, i] = r[..., j, k] - r[..., k, j]
    best = np.argmax(np.einsum("...ii->...i", candidates), axis=-1)
    chosen: FloatArray = np.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :]
    chosen *= np.where(chosen[..., 3:] < 0, -1.0, 1.0)
    chosen /= np.linalg.norm(chosen, axis=-1, keepdims=True)
    return chosen

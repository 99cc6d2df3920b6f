"""Where a camera sees a point: pinhole and fisheye models, as calibration messages describe them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from perception_server.errors import NoDataError

FloatArray = NDArray[np.float64]
LensModel = Literal["pinhole", "fisheye"]

MAX_SIDE_PX = 16_384
_PINHOLE_NAMES = frozenset({"", "plumb_bob", "rational_polynomial"})
_FISHEYE_NAMES = frozenset({"kannala_brandt", "equidistant", "fisheye"})
_PINHOLE_COUNTS = (0, 4, 5, 8)
_ANGLE_STEPS = 4096


@dataclass(frozen=True, slots=True)
class CameraModel:
    """Intrinsics of one camera; pixel centres are at whole numbers.

    coefficients: pinhole k1 k2 p1 p2 [k3 [k4 k5 k6]] (OpenCV's order), fisheye k1..k4 of
    theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) (Kannala and Brandt 2006).
    """

    width_px: int
    height_px: int
    focal_x_px: float
    focal_y_px: float
    centre_x_px: float
    centre_y_px: float
    lens: LensModel
    coefficients: tuple[float, ...]

    def project(self, points: FloatArray) -> FloatArray:
        """(..., 2) pixels of (..., 3) points in the optical frame (z forward, x right, y down).

        NaN where the lens does not see: behind a pinhole, beyond the angle up to which its distortion
        grows with the angle.
        """
        x, y, z = np.moveaxis(points, -1, 0)
        radius = np.hypot(x, y)
        angle = np.arctan2(radius, z)
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.lens == "fisheye":
                stretch = np.where(radius > 0, self._distorted_angle(angle) / radius, 1.0)
                flat_x, flat_y = x * stretch, y * stretch
            else:
                flat_x, flat_y = self._distorted_plane(x / z, y / z)
        pixels: FloatArray = np.stack(
            [flat_x * self.focal_x_px + self.centre_x_px, flat_y * self.focal_y_px + self.centre_y_px],
            axis=-1,
        )
        pixels[angle >= self.largest_angle_rad()] = np.nan
        return pixels

    def largest_angle_rad(self) -> float:
        """The angle off the axis beyond which two directions would share a pixel."""
        whole = math.pi if self.lens == "fisheye" else math.pi / 2
        angles = np.linspace(0.0, whole, _ANGLE_STEPS, endpoint=False)
        if self.lens == "fisheye":
            radii = self._distorted_angle(angles)
        else:
            radii = self._distorted_plane(np.tan(angles), np.zeros_like(angles), tangential=False)[0]
        falling = np.flatnonzero(~(np.diff(radii) > 0))
        return float(angles[falling[0]]) if falling.size else whole

    def _distorted_angle(self, angle: FloatArray) -> FloatArray:
        k1, k2, k3, k4 = (*self.coefficients, 0.0, 0.0, 0.0, 0.0)[:4]
        square = angle * angle
        distorted: FloatArray = angle * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4))))
        return distorted

    def _distorted_plane(
        self, x: FloatArray, y: FloatArray, *, tangential: bool = True
    ) -> tuple[FloatArray, FloatArray]:
        k1, k2, p1, p2, k3, k4, k5, k6 = (*self.coefficients, *([0.0] * 8))[:8]
        if not tangential:
            p1 = p2 = 0.0
        square = x * x + y * y
        above = 1 + square * (k1 + square * (k2 + square * k3))
        below = 1 + square * (k4 + square * (k5 + square * k6))
        radial = above / below
        return (
            x * radial + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * radial + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
        )


def camera_model(
    width_px: int, height_px: int, distortion_model: str, distortion: Sequence[float], matrix: Sequence[float]
) -> CameraModel:
    """A model from the fields of CameraInfo or foxglove.CameraCalibration (D, and K by rows).

    Raises NoDataError that names the field.
    """
    for name, side in (("width", width_px), ("height", height_px)):
        if not 1 <= side <= MAX_SIDE_PX:
            raise NoDataError(f"calibration: {name} = {side}: must be within 1..{MAX_SIDE_PX}")
    if len(matrix) != 9:
        raise NoDataError(f"calibration: K has {len(matrix)} numbers: must have 9")
    if not all(map(math.isfinite, (*matrix, *distortion))):
        raise NoDataError("calibration: K and D must be finite numbers")
    focal_x, _, centre_x, _, focal_y, centre_y, *_ = matrix
    if focal_x <= 0 or focal_y <= 0:
        raise NoDataError(
            f"calibration: K has focal lengths {focal_x:g}, {focal_y:g}: must be above 0 pixels"
        )
    lens = _lens(distortion_model, len(distortion))
    coefficients = tuple(float(value) for value in distortion)
    return CameraModel(width_px, height_px, focal_x, focal_y, centre_x, centre_y, lens, coefficients)


def _lens(distortion_model: str, count: int) -> LensModel:
    if distortion_model in _FISHEYE_NAMES:
        if count not in (0, 4):
            raise NoDataError(f"calibration: D has {count} numbers: {distortion_model} has 4")
        return "fisheye"
    if distortion_model in _PINHOLE_NAMES:
        if count not in _PINHOLE_COUNTS:
            raise NoDataError(
                f"calibration: D has {count} numbers: {distortion_model or 'plumb_bob'} has 4, 5 or 8"
            )
        return "pinhole"
    known = ", ".join(sorted((_PINHOLE_NAMES | _FISHEYE_NAMES) - {""}))
    raise NoDataError(f"calibration: distortion_model = {distortion_model!r}: must be one of {known}")

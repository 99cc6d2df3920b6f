"""Virtual cameras: a straight view into a part of what a wide lens sees."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from perception_server.camera_model import CameraModel, FloatArray
from perception_server.errors import RequestError

Picture = NDArray[np.uint8]  # (rows, columns, 3) BGR, or (rows, columns) grey

MAX_VIEW_SIDE_PX = 2048
_MAX_FIELD_OF_VIEW_RAD = math.radians(170)  # a flat picture of more is mostly border
_MAX_OVERSAMPLING = 4


@dataclass(frozen=True, slots=True)
class VirtualView:
    """A distortion-free camera at the place of a real one, turned.

    pan_rad: to the left; tilt_rad: up, as the camera itself would be turned.
    field_of_view_rad: from the left edge to the right edge.
    """

    pan_rad: float = 0.0
    tilt_rad: float = 0.0
    field_of_view_rad: float = math.radians(80)
    width_px: int = 256
    height_px: int = 320

    def __post_init__(self) -> None:
        for name, value, low, high in (
            ("pan_rad", self.pan_rad, -math.pi, math.pi),
            ("tilt_rad", self.tilt_rad, -math.pi / 2, math.pi / 2),
            ("field_of_view_rad", self.field_of_view_rad, math.radians(1), _MAX_FIELD_OF_VIEW_RAD),
            ("width_px", self.width_px, 1, MAX_VIEW_SIDE_PX),
            ("height_px", self.height_px, 1, MAX_VIEW_SIDE_PX),
        ):
            if not low <= value <= high:
                raise RequestError(f"{name} = {value:g}: must be within {low:.4g}..{high:.4g}")

    @property
    def focal_px(self) -> float:
        """Focal length of the virtual pinhole; its optical axis is in the middle of the picture."""
        return self.width_px / 2 / math.tan(self.field_of_view_rad / 2)

    def camera_from_virtual(self) -> FloatArray:
        """(3, 3): turns directions of the virtual optical frame into the real camera's."""
        pan, tilt = self.pan_rad, self.tilt_rad
        about_y = np.array([[math.cos(pan), 0, -math.sin(pan)], [0, 1, 0], [math.sin(pan), 0, math.cos(pan)]])
        about_x = np.array(
            [[1, 0, 0], [0, math.cos(tilt), -math.sin(tilt)], [0, math.sin(tilt), math.cos(tilt)]]
        )
        turned: FloatArray = about_y @ about_x
        return turned


def rectify(picture: Picture, camera: CameraModel, view: VirtualView) -> Picture:
    """What the virtual camera would have seen; black where the real one saw nothing.

    A picture of another size than the calibration's is taken as the same picture, scaled. Where the view
    is coarser than the source, several samples are averaged for each pixel. Raises RequestError if the view
    lies wholly outside of the picture.
    """
    rows, columns = picture.shape[:2]
    sampling = _oversampling(camera, view, columns / camera.width_px)
    map_x, map_y = _source_pixels(camera, view, sampling)
    scale_x, scale_y = columns / camera.width_px, rows / camera.height_px
    if (scale_x, scale_y) != (1.0, 1.0):
        map_x = (map_x + np.float32(0.5)) * np.float32(scale_x) - np.float32(0.5)
        map_y = (map_y + np.float32(0.5)) * np.float32(scale_y) - np.float32(0.5)
    if not np.any((map_x > -1) & (map_x < columns) & (map_y > -1) & (map_y < rows)):
        raise RequestError(
            f"pan_rad = {view.pan_rad:g}, tilt_rad = {view.tilt_rad:g}: the camera sees nothing there"
        )
    straight: Picture = cv2.remap(picture, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    if sampling == 1:
        return straight
    averaged: Picture = cv2.resize(straight, (view.width_px, view.height_px), interpolation=cv2.INTER_AREA)
    return averaged


def _oversampling(camera: CameraModel, view: VirtualView, scale: float) -> int:
    """Samples per pixel and direction so that neighbouring samples are at most one source pixel apart."""
    source_px_per_rad = max(camera.focal_x_px, camera.focal_y_px) * scale
    return max(1, min(_MAX_OVERSAMPLING, round(source_px_per_rad / view.focal_px)))


@lru_cache(maxsize=8)
def _source_pixels(
    camera: CameraModel, view: VirtualView, sampling: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """(rows, columns) maps of where each sample of the view lies in the source; far outside for unseen."""
    columns = (np.arange(view.width_px * sampling) + 0.5) / sampling - view.width_px / 2
    rows = (np.arange(view.height_px * sampling) + 0.5) / sampling - view.height_px / 2
    rays = np.empty((rows.size, columns.size, 3))
    rays[..., 0] = columns[None, :]
    rays[..., 1] = rows[:, None]
    rays[..., 2] = view.focal_px
    pixels = np.nan_to_num(
        camera.project(rays @ view.camera_from_virtual().T), nan=-1e4, posinf=-1e4, neginf=-1e4
    )
    maps = np.clip(pixels, -1e4, 1e6).astype(np.float32)
    return np.ascontiguousarray(maps[..., 0]), np.ascontiguousarray(maps[..., 1])

"""Pictures of the last while: camera frames as they came, disparity images, calibrations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class CameraFrame:
    """One picture of one camera.

    source: the camera's name; with capture_ns the frame's identity.
    encoding: "jpeg", "png", "webp" for data as a file; "rgb8", "bgr8", "rgba8", "bgra8", "mono8" for raw
    pixels, of which width_px, height_px and row_bytes say how they lie. 0 for files: the file knows.
    """

    source: str
    frame_id: str
    capture_ns: int
    encoding: str
    data: bytes
    width_px: int = 0
    height_px: int = 0
    row_bytes: int = 0

    @property
    def size_bytes(self) -> int:
        """What it takes in memory."""
        return len(self.data)


@dataclass(frozen=True, slots=True)
class Disparity:
    """A stereo camera's disparity image.

    disparity_px: (rows, columns) float32; NaN or <= 0 where none was found.
    Depth along the optical axis is focal_px * baseline_m / disparity_px (REP-118's inverse).
    """

    source: str
    frame_id: str
    capture_ns: int
    disparity_px: NDArray[np.float32]
    focal_px: float
    baseline_m: float
    centre_x_px: float
    centre_y_px: float

    @property
    def size_bytes(self) -> int:
        """What it takes in memory."""
        return self.disparity_px.nbytes


@dataclass(frozen=True, slots=True)
class Calibration:
    """A camera's intrinsics, as foxglove.CameraCalibration and sensor_msgs/CameraInfo have them.

    distortion_model: "plumb_bob", "rational_polynomial", "kannala_brandt", "equidistant", or "".
    k: 9, r: 9, p: 12 numbers by rows, d: as many as the model has.
    """

    frame_id: str
    width_px: int
    height_px: int
    distortion_model: str
    d: tuple[float, ...]
    k: tuple[float, ...]
    r: tuple[float, ...]
    p: tuple[float, ...]


Picture = TypeVar("Picture", CameraFrame, Disparity)


class PictureRing:
    """Camera frames and disparity images in order of arrival, the oldest dropped by age and by bytes.

    `cameras` and `disparities` are replaced, never changed.
    """

    def __init__(self, max_bytes: int, max_age_ns: int) -> None:
        self._max_bytes = max_bytes
        self._max_age_ns = max_age_ns
        self._bytes = 0
        self._newest_ns = 0
        self.cameras: dict[str, tuple[CameraFrame, ...]] = {}
        self.disparities: tuple[Disparity, ...] = ()

    def append(self, picture: CameraFrame | Disparity) -> None:
        """Keep a picture; one older than its source's newest goes to its place in time."""
        self._bytes += picture.size_bytes
        self._newest_ns = max(self._newest_ns, picture.capture_ns)
        if isinstance(picture, Disparity):
            self.disparities = _in_order((*self.disparities, picture))
        else:
            frames = (*self.cameras.get(picture.source, ()), picture)
            self.cameras = {**self.cameras, picture.source: _in_order(frames)}
        while self._drop_oldest():
            pass

    def _drop_oldest(self) -> bool:
        queues: list[tuple[CameraFrame, ...] | tuple[Disparity, ...]] = [*self.cameras.values()]
        if self.disparities:
            queues.append(self.disparities)
        if not queues:
            return False
        oldest = min((queue[0] for queue in queues), key=lambda picture: picture.capture_ns)
        expired = oldest.capture_ns < self._newest_ns - self._max_age_ns
        if not expired and self._bytes <= self._max_bytes:
            return False
        self._bytes -= oldest.size_bytes
        if isinstance(oldest, Disparity):
            self.disparities = self.disparities[1:]
        else:
            left = self.cameras[oldest.source][1:]
            others = {name: frames for name, frames in self.cameras.items() if name != oldest.source}
            self.cameras = {**others, oldest.source: left} if left else others
        return True


def _in_order(pictures: tuple[Picture, ...]) -> tuple[Picture, ...]:
    if len(pictures) > 1 and pictures[-1].capture_ns < pictures[-2].capture_ns:
        return tuple(sorted(pictures, key=lambda picture: picture.capture_ns))
    return pictures

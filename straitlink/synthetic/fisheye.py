"""The chest camera: a fisheye, resampled from a pinhole view."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from straitlink.synthetic.camera import Pinhole, Renderer
from straitlink.synthetic.rigid import FloatArray
from straitlink.synthetic.scene import Box
from straitlink.synthetic.settings import Texture
from straitlink.synthetic.textures import Image


class FisheyeRenderer:
    """An equidistant fisheye (Kannala-Brandt with k1..k4 = 0), resampled from a wider pinhole view."""

    def __init__(
        self,
        boxes: Sequence[Box],
        size: tuple[int, int],
        field_of_view_rad: float,
        texture: Texture,
        seed: int,
    ) -> None:
        width, height = size
        self.width, self.height = width, height
        self.focal_pixels = (width / 2) / (field_of_view_rad / 2)
        half = field_of_view_rad / 2
        pinhole_width, pinhole_height = width, height
        pinhole = Pinhole(pinhole_width, pinhole_height, pinhole_width / 2 / np.tan(half))
        self._renderer = Renderer(boxes, pinhole, texture, seed)
        x = (np.arange(width) - (width - 1) / 2)[None, :]
        y = (np.arange(height) - (height - 1) / 2)[:, None]
        radius = np.hypot(x, y)
        angle = radius / self.focal_pixels
        stretch = np.where(
            angle < half,
            np.tan(np.minimum(angle, half)) * pinhole.focal_pixels / np.maximum(radius, 1e-9),
            np.nan,
        )
        # Outside of the lens's circle the map points off the image, which the border paints black.
        map_x = np.nan_to_num(x * stretch + (pinhole_width - 1) / 2, nan=-1e4).astype(np.float32)
        map_y = np.nan_to_num(y * stretch + (pinhole_height - 1) / 2, nan=-1e4).astype(np.float32)
        self._maps = cv2.convertMaps(map_x, map_y, cv2.CV_16SC2)

    def expose(self, map_from_optical: FloatArray) -> Image:
        """A (height, width, 3) BGR frame with noise."""
        image: Image = cv2.remap(
            self._renderer.expose(map_from_optical),
            self._maps[0],
            self._maps[1],
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
        )
        return image

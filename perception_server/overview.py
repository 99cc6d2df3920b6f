"""A small picture of a large one: what an operator can have each second in a thin band."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

MAX_SOURCE_BYTES = 16_000_000
MAX_SOURCE_PIXELS = 40_000_000  # a decoded picture is three bytes a pixel


class ViewError(Exception):
    """A view cannot be rendered from what there is; the message says why."""


@dataclass(frozen=True, slots=True)
class Overview:
    """Size and JPEG quality of an overview.

    The default is the head camera's product of Team MIT's system at the DRC Trials, 256x136 at quality
    50: about 5 kB, 0.4 s of a 100 kbit/s link.
    """

    width_px: int = 256
    height_px: int = 136
    quality: int = 50

    def __post_init__(self) -> None:
        for name, value, high in (
            ("width_px", self.width_px, 8192),
            ("height_px", self.height_px, 8192),
            ("quality", self.quality, 100),
        ):
            if not 1 <= value <= high:
                raise ViewError(f"an overview's {name} = {value} must be within 1..{high}")


def render_overview(source: bytes, overview: Overview) -> bytes:
    """Shrink a compressed picture (JPEG, PNG, WebP) into a JPEG that decodes alone.

    Areas are averaged, so that texture does not alias. The picture's proportions are kept: it is made
    as large as fits into width x height. Raises ViewError for bytes that are no picture.
    """
    if not source or len(source) > MAX_SOURCE_BYTES:
        raise ViewError(f"a picture of {len(source)} bytes is outside 1..{MAX_SOURCE_BYTES}")
    try:
        picture = cv2.imdecode(np.frombuffer(source, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error as error:
        raise ViewError(f"the picture cannot be decoded: {error.err}") from error
    if picture is None:
        raise ViewError("the bytes are no picture that can be decoded")
    rows, columns = picture.shape[:2]
    if rows * columns > MAX_SOURCE_PIXELS:
        raise ViewError(f"a picture of {columns}x{rows} has more than {MAX_SOURCE_PIXELS} pixels")
    scale = min(1.0, overview.width_px / columns, overview.height_px / rows)
    size = (max(1, round(columns * scale)), max(1, round(rows * scale)))
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    _, jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, overview.quality])
    return bytes(jpeg)

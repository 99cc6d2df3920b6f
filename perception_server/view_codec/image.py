"""Pictures at a quality or within a number of bytes: JPEG that travels packed, or WebP."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from .codec_id import CodecId
from .errors import EncodeError
from .jpeg import pack_jpeg

ImageFormat = Literal["jpeg", "webp"]
DEFAULT_QUALITY = 50
MAX_SIDE_PIXELS = 16_383  # WebP's (RFC 9649, section 2.7)
_WRITERS: dict[str, tuple[str, int]] = {
    "jpeg": (".jpg", cv2.IMWRITE_JPEG_QUALITY),
    "webp": (".webp", cv2.IMWRITE_WEBP_QUALITY),
}


def encode_image(
    image: NDArray[np.uint8],
    format: ImageFormat = "jpeg",
    quality: int | None = None,
    max_bytes: int | None = None,
) -> bytes:
    """One message for a picture; `unpack_jpeg` gives its JPEG or WebP file back.

    image: (rows, columns) grey or (rows, columns, 3) BGR, 8 bits.
    quality: 1..100 on the format's own scale, 50 if neither is given; where max_bytes is given, the most.
    max_bytes: the message's size; the best quality that fits is found in seven tries.
    Raises EncodeError for what is no picture, and where quality 1 is larger than max_bytes.
    """
    _check_picture(image)
    if format not in _WRITERS:
        raise EncodeError(f"format = {format!r} must be one of {', '.join(_WRITERS)}")
    if quality is not None and not 1 <= quality <= 100:
        raise EncodeError(f"quality = {quality} is outside 1..100")
    if max_bytes is None:
        return _encoded(image, format, quality or DEFAULT_QUALITY)
    return _within(image, format, quality or 100, max_bytes)


def _within(image: NDArray[np.uint8], format: str, most_quality: int, max_bytes: int) -> bytes:
    """The largest of the messages tried that fit: sizes grow with quality, but for a few bytes."""
    low, high, best = 1, most_quality, b""
    while low <= high:
        quality = (low + high) // 2
        message = _encoded(image, format, quality)
        if len(message) <= max_bytes:
            best, low = message, quality + 1
        else:
            high = quality - 1
    if not best:
        least = len(_encoded(image, format, 1))
        raise EncodeError(f"max_bytes = {max_bytes}: this {format} of quality 1 has {least}")
    return best


def _encoded(image: NDArray[np.uint8], format: str, quality: int) -> bytes:
    suffix, flag = _WRITERS[format]
    try:
        written, data = cv2.imencode(suffix, image, [flag, quality])
    except cv2.error as error:
        raise EncodeError(f"this build of OpenCV writes no {format}: {error.err}") from error
    if not written:
        raise EncodeError(f"a picture of shape {image.shape} cannot be written as {format}")
    file = data.tobytes()
    return pack_jpeg(file) if format == "jpeg" else bytes([CodecId.IMAGE_FILE]) + file


def _check_picture(image: NDArray[np.uint8]) -> None:
    shaped = image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
    if image.dtype != np.uint8 or not shaped:
        raise EncodeError(
            f"a picture of {image.dtype} and shape {image.shape} must be uint8, (rows, columns[, 3])"
        )
    if not 1 <= min(image.shape[:2]) <= max(image.shape[:2]) <= MAX_SIDE_PIXELS:
        raise EncodeError(f"a picture of shape {image.shape} must have sides of 1..{MAX_SIDE_PIXELS} pixels")

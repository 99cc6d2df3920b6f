"""Pictures as files: their size before they are decoded, and decoding within bounds."""

from __future__ import annotations

import cv2
import numpy as np

from messages.proto.straitlink.view_pb2 import ImageRequest
from perception_server.errors import NoDataError, RequestError
from perception_server.fisheye import Picture
from perception_server.pictures import CameraFrame
from perception_server.view_codec import CodecId, DecodeError, pack_jpeg, unpack_jpeg

MAX_PIXELS = 2048 * 2048  # of what crosses: a composite, its base and a chip as bytes are 38 MB
MAX_SOURCE_PIXELS = 40_000_000  # of a camera on this host
MAX_FILE_BYTES = 16_000_000
_PACKED = tuple(bytes([codec]) for codec in CodecId if codec >> 4 == CodecId.IMAGE_JPEG >> 4)
_MAX_JPEG_SCANS = 32  # an honest progressive file has about ten; each costs a pass over the picture
_JPEG_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # SOF markers (ITU-T T.81, table B.1)
_JPEG_BARE = frozenset((0x01, *range(0xD0, 0xD8)))  # markers without a length
_SOS, _EOI = 0xDA, 0xD9
_RAW_CHANNELS = {"mono8": 1, "rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4}
_TO_BGR = {"rgb8": cv2.COLOR_RGB2BGR, "rgba8": cv2.COLOR_RGBA2BGR, "bgra8": cv2.COLOR_BGRA2BGR}
_WRITERS = {
    ImageRequest.FORMAT_JPEG: (".jpg", (cv2.IMWRITE_JPEG_OPTIMIZE, 1, cv2.IMWRITE_JPEG_QUALITY)),
    ImageRequest.FORMAT_PACKED_JPEG: (".jpg", (cv2.IMWRITE_JPEG_QUALITY,)),
    ImageRequest.FORMAT_WEBP: (".webp", (cv2.IMWRITE_WEBP_QUALITY,)),
}


def decode_frame(frame: CameraFrame) -> Picture:
    """A camera's frame as (rows, columns, 3) BGR or (rows, columns) grey. Raises NoDataError."""
    if frame.encoding not in _RAW_CHANNELS:
        try:
            return decode_picture(frame.data, MAX_SOURCE_PIXELS)
        except DecodeError as error:
            raise NoDataError(f"{frame.source}: frame {frame.capture_ns} is unreadable: {error}") from error
    channels = _RAW_CHANNELS[frame.encoding]
    rows, columns = frame.height_px, frame.width_px
    row_bytes = frame.row_bytes or columns * channels
    if min(rows, columns) < 1 or row_bytes < columns * channels or len(frame.data) < rows * row_bytes:
        raise NoDataError(
            f"{frame.source}: frame {frame.capture_ns} is unreadable: {len(frame.data)} bytes are not "
            f"{columns}x{rows} pixels of {frame.encoding}"
        )
    lines = np.frombuffer(frame.data, np.uint8, rows * row_bytes).reshape(rows, row_bytes)
    pixels = lines[:, : columns * channels].reshape(rows, columns, channels)
    if channels == 1:
        return pixels[..., 0]
    if frame.encoding == "bgr8":
        return pixels
    picture: Picture = cv2.cvtColor(np.ascontiguousarray(pixels), _TO_BGR[frame.encoding])
    return picture


def decode_picture(data: bytes, max_pixels: int = MAX_PIXELS) -> Picture:
    """(rows, columns, 3) BGR, or (rows, columns) where it is grey, of a JPEG, packed JPEG, PNG or WebP.

    Raises DecodeError for anything else, before any memory is taken for more than max_pixels.
    """
    data = plain_file(data)
    width, height = picture_size(data)
    if width * height > max_pixels:
        raise DecodeError(f"a picture of {width}x{height} has more than {max_pixels} pixels")
    try:
        flags = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION  # calibrations are of pixels as stored
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise DecodeError(f"the picture cannot be decoded: {error.err}") from error
    if picture is None:
        raise DecodeError("the picture cannot be decoded")
    if picture.shape[:2] != (height, width):
        raise DecodeError(f"the picture is not of the {width}x{height} pixels that its header says")
    decoded: Picture = picture
    return decoded


def encode_picture(picture: Picture, form: ImageRequest.Format.ValueType, quality: int) -> bytes:
    """A picture as a file of the format, at a quality of 1..100. Raises RequestError: format."""
    suffix, parameters = _WRITERS.get(form, ("", ()))
    if not suffix:
        known = ", ".join(ImageRequest.Format.Name(each) for each in _WRITERS)
        raise RequestError(f"format = {form}: must be one of {known}")
    written, data = cv2.imencode(suffix, picture, [*parameters, quality])
    if not written:
        raise RequestError(f"format = {ImageRequest.Format.Name(form)}: cannot hold this picture")
    file = data.tobytes()
    return pack_jpeg(file) if form == ImageRequest.FORMAT_PACKED_JPEG else file


def plain_file(data: bytes) -> bytes:
    """The JPEG, PNG or WebP file of an encoded picture, pixels as they were sent. Raises DecodeError."""
    return unpack_jpeg(data) if data[:1] in _PACKED else data


def picture_size(data: bytes) -> tuple[int, int]:
    """Width and height as a file's header has them. Raises DecodeError."""
    if not data or len(data) > MAX_FILE_BYTES:
        raise DecodeError(f"a picture of {len(data)} bytes is outside 1..{MAX_FILE_BYTES}")
    if data.startswith(b"\xff\xd8"):
        return _jpeg_size(data)
    if data.startswith(b"\x89PNG\r\n\x1a\n") and data[12:16] == b"IHDR" and len(data) >= 24:
        return int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    if data[:4] == b"RIFF" and data[8:12] == b"WEBP" and len(data) >= 30:
        return _webp_size(data)
    raise DecodeError("the bytes are no JPEG, PNG or WebP file")


def _jpeg_size(data: bytes) -> tuple[int, int]:
    """From the frame header; a file with more frames or scans than an honest one has is refused."""
    size: tuple[int, int] | None = None
    position = scans = 0
    while (position := data.find(b"\xff", position)) >= 0 and position + 1 < len(data):
        marker = data[position + 1]
        if marker in (0x00, 0xFF) or marker in _JPEG_BARE or marker == 0xD8:
            position += 1 if marker == 0xFF else 2
            continue
        if marker == _EOI:
            break
        length = int.from_bytes(data[position + 2 : position + 4], "big")
        if marker in _JPEG_FRAMES:
            if size is not None or position + 9 > len(data):
                raise DecodeError("the JPEG file has no frame header, or more than one")
            size = _big(data, position + 7), _big(data, position + 5)
        scans += marker == _SOS
        if scans > _MAX_JPEG_SCANS:
            raise DecodeError(f"the JPEG file has more than {_MAX_JPEG_SCANS} scans")
        position += 2 + length
    if size is None or 0 in size:
        raise DecodeError("the JPEG file has no frame header with a size")
    return size


def _webp_size(data: bytes) -> tuple[int, int]:
    """From the first chunk (RFC 9649, section 2): VP8, VP8L, or the canvas of VP8X without animation."""
    kind = data[12:16]
    if kind == b"VP8 " and data[23:26] == b"\x9d\x01\x2a":
        return int.from_bytes(data[26:28], "little") & 0x3FFF, int.from_bytes(data[28:30], "little") & 0x3FFF
    if kind == b"VP8L" and data[20] == 0x2F:
        bits = int.from_bytes(data[21:25], "little")
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    raise DecodeError("the WebP file is not one plain picture")


def _big(data: bytes, position: int) -> int:
    return int.from_bytes(data[position : position + 2], "big")

"""The first byte of every encoded view: which product it is and how it was coded.

The high nibble is the product, the low one the codec. A number, once given, is never given again.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum, unique

from .errors import DecodeError, EncodeError


@unique
class CodecId(IntEnum):
    """Every codec there is; docs/view_codecs.md has the bytes that follow."""

    MAP_ZLIB = 0x10  # the paper's: quantised cells, zlib
    MAP_SERPENTINE = 0x11  # differences along a serpentine, LZMA
    MAP_CONTEXT = 0x12  # context mixing
    CLOUD_ZLIB = 0x20  # the paper's: interleaved x, y, z, zlib
    CLOUD_ZSTD = 0x21  # breadth-first occupancy, zstd
    CLOUD_CONTEXT = 0x22  # breadth-first occupancy, context mixing
    OCTREE_ZSTD = 0x31
    OCTREE_CONTEXT = 0x32
    IMAGE_JPEG = 0x40  # a JPEG without the tables that every decoder knows
    IMAGE_FILE = 0x41  # a JPEG or WebP file as it is
    IMAGE_JPEG_CONTEXT = 0x42  # a JPEG's coefficients, context mixing


def codec_of(data: bytes) -> CodecId:
    """The codec that wrote the message. Raises DecodeError for an empty one and for unknown codecs."""
    if not data:
        raise DecodeError("a view of 0 bytes has no codec byte")
    try:
        return CodecId(data[0])
    except ValueError:
        raise DecodeError(f"codec 0x{data[0]:02x} is unknown") from None


def wished_codec(wish: CodecId | str | None, names: Mapping[str, CodecId]) -> CodecId | None:
    """The codec that an encoder was asked for, by name or number. Raises EncodeError for another's."""
    codec = names.get(wish) if isinstance(wish, str) else wish
    if wish is not None and codec not in names.values():
        raise EncodeError(f"codec = {wish!r} is none of {', '.join(names)}")
    return codec

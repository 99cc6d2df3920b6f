"""Payloads that no schema of ours describes: sent as they are, or through zstd when that is smaller."""

from __future__ import annotations

import zstandard

from shaper.errors import DecodeError
from shaper.traffic_class import Compression

_LEVEL = 6  # about 40 MB/s on one core; the link carries at most a few per cent of that
_compressor = zstandard.ZstdCompressor(level=_LEVEL)
_decompressor = zstandard.ZstdDecompressor()


def pack(payload: bytes, compression: Compression) -> tuple[bytes, bool]:
    """The bytes to send, and whether they are compressed."""
    if compression is Compression.ZSTD and payload:
        packed = _compressor.compress(payload)
        if len(packed) < len(payload):
            return packed, True
    return payload, False


def unpack(data: bytes, max_bytes: int) -> bytes:
    """Undo `pack` for compressed data of at most max_bytes. Raises DecodeError."""
    try:
        declared = zstandard.frame_content_size(data)
        if not 0 <= declared <= max_bytes:
            raise DecodeError(f"a payload of {declared} bytes is outside 0..{max_bytes}")
        return _decompressor.decompress(data, max_output_size=max_bytes)
    except zstandard.ZstdError as error:
        raise DecodeError(f"a payload is not zstd: {error}") from error

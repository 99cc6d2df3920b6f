"""One zstd frame without what a message knows anyway: magic number, size, checksum."""

from __future__ import annotations

from collections.abc import Sequence

import zstandard

from .errors import DecodeError

_LEVEL = 19
_MAX_WINDOW_BYTES = 1 << 23  # what level 19 may ask for
_PIECE_BYTES = 256  # read at once: a block of 4 bytes can stand for 128 kB, so 8 MB a piece at most


def zstd_frame(parts: Sequence[bytes]) -> bytes:
    """The parts one behind the other; each starts a block and so has statistics of its own.

    Its size is made known for smaller tables: they take ten times as long to clear as a view to code.
    """
    parameters = zstandard.ZstdCompressionParameters.from_level(
        _LEVEL,
        source_size=sum(map(len, parts)),
        write_content_size=False,
        write_checksum=False,
        format=zstandard.FORMAT_ZSTD1_MAGICLESS,
    )
    stream = zstandard.ZstdCompressor(compression_params=parameters).compressobj()
    coded = []
    for part in parts:
        coded += [stream.compress(part), stream.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)]
    return b"".join([*coded, stream.flush()])


def read_zstd_frame(data: bytes, most_bytes: int) -> bytes:
    """The content of exactly one frame. Raises DecodeError for anything else and past `most_bytes`."""
    reader = zstandard.ZstdDecompressor(
        max_window_size=_MAX_WINDOW_BYTES, format=zstandard.FORMAT_ZSTD1_MAGICLESS
    ).decompressobj()
    content, position = bytearray(), 0
    try:
        while position < len(data) and not reader.eof:
            content += reader.decompress(data[position : position + _PIECE_BYTES])
            position += _PIECE_BYTES
            if len(content) > most_bytes:
                raise DecodeError(f"a zstd frame holds more than {most_bytes} bytes")
    except zstandard.ZstdError as error:
        raise DecodeError(f"the zstd frame is unsound: {error}") from None
    if not reader.eof or reader.unused_data or position < len(data):
        raise DecodeError(f"the zstd frame does not end with its message of {len(data)} bytes")
    return bytes(content)

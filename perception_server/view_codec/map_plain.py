"""Maps without a model: the paper's zlib, and differences along a serpentine under zstd.

Neither needs more than NumPy and zstandard; the reader takes no more memory than the grid says.
"""

from __future__ import annotations

import io
import zlib

import numpy as np
import zstandard
from numpy.typing import NDArray

from .errors import DecodeError
from .map_header import MapFlag, MapHeader
from .palette import from_ranks, to_ranks
from .quantisation import HOLE, Codes

_ZLIB_LEVEL = 9
_ZSTD_LEVEL = 19
_MOST_WINDOW_BYTES = 1 << 21
_compressor = zstandard.ZstdCompressor(
    level=_ZSTD_LEVEL, write_content_size=False, write_checksum=False, write_dict_id=False
)
_decompressor = zstandard.ZstdDecompressor(max_window_size=_MOST_WINDOW_BYTES)


def zlib_encode(cells: Codes) -> bytes:
    """Every cell row by row, one byte or two (little endian), the highest number for holes; zlib."""
    kind = _code_type(cells.levels)
    raw = np.where(cells.valid, cells.codes, np.iinfo(kind).max).astype(kind)
    return zlib.compress(raw.tobytes(), _ZLIB_LEVEL)


def zlib_decode(stream: bytes, header: MapHeader) -> NDArray[np.int64]:
    """(rows, columns) codes. Raises DecodeError."""
    kind = _code_type(header.levels)
    size = header.rows * header.columns * kind.itemsize
    inflater = zlib.decompressobj()
    try:
        raw = inflater.decompress(stream, size + 1)
    except zlib.error as error:
        raise DecodeError(f"a map's zlib stream is broken: {error}") from error
    if len(raw) != size or not inflater.eof or inflater.unused_data:
        raise DecodeError(f"a map's zlib stream is not exactly {size} bytes")
    cells = np.frombuffer(raw, kind).astype(np.int64)
    cells[cells == np.iinfo(kind).max] = HOLE
    return cells.reshape(header.rows, header.columns)


def serpentine_encode(cells: Codes, used: NDArray[np.bool_] | None) -> bytes:
    """The mask's bits, the palette's if there is one, then the differences; zstd over all."""
    parts = [np.packbits(cells.valid)]
    if used is not None:
        parts.append(np.packbits(used))
        cells = to_ranks(cells, used)
    walk = _serpentine(cells.codes)
    steps = np.diff(walk[walk != HOLE], prepend=0)
    if cells.levels <= 256:
        parts.append(steps.astype(np.uint8))  # modulo 256
    else:
        folded = np.where(steps < 0, -2 * steps - 1, 2 * steps)  # small either way, and below 2**17
        parts += [(folded >> shift & 255).astype(np.uint8) for shift in (0, 8, 16)]
    return _compressor.compress(b"".join(part.tobytes() for part in parts))


def serpentine_decode(stream: bytes, header: MapHeader) -> NDArray[np.int64]:
    """(rows, columns) codes. Raises DecodeError."""
    rows, columns, levels = header.rows, header.columns, header.levels
    body = io.BytesIO(_inflated(stream, rows * columns * 3 + rows * columns // 8 + levels // 8 + 2))
    valid = _bits(body, rows * columns, "mask").reshape(rows, columns)
    used = _bits(body, levels, "palette") if header.flags & MapFlag.PALETTE else None
    if used is not None:
        levels = int(used.sum())
    rest = np.frombuffer(body.read(), np.uint8)
    count, planes = int(valid.sum()), 1 if levels <= 256 else 3
    if len(rest) != count * planes:
        raise DecodeError(f"{len(rest)} bytes of differences are not {planes} for each of {count} cells")
    if planes == 1:
        measured = np.cumsum(rest, dtype=np.uint8).astype(np.int64)
    else:
        low, middle, high = rest.astype(np.int64).reshape(3, count)
        folded = low | middle << 8 | high << 16
        measured = np.cumsum(np.where(folded & 1, -(folded >> 1) - 1, folded >> 1))
    if count and not 0 <= measured.min() <= measured.max() < levels:
        raise DecodeError(f"differences lead outside 0..{levels - 1}")
    walk = _serpentine(valid.astype(np.int64) - 1)
    walk[walk != HOLE] = measured
    codes = _serpentine(walk.reshape(rows, columns)).reshape(rows, columns)
    return codes if used is None else from_ranks(codes, used)


def _code_type(levels: int) -> np.dtype[np.unsignedinteger]:
    return np.dtype(np.uint8) if levels <= 255 else np.dtype("<u2")


def _serpentine(grid: NDArray[np.int64]) -> NDArray[np.int64]:
    """The cells from left to right, then from right to left, row by row; its own inverse."""
    walk = grid.copy()
    walk[1::2] = walk[1::2, ::-1]
    return walk.reshape(-1)


def _inflated(stream: bytes, most_bytes: int) -> bytes:
    """The content of a stream that is one frame, no longer than `most_bytes`, and nothing else."""
    try:
        size = zstandard.get_frame_parameters(stream).content_size
        if size not in (0, zstandard.CONTENTSIZE_UNKNOWN):
            raise DecodeError("a map's zstd frame claims its size, which none of ours does")
        raw = _decompressor.decompress(stream, max_output_size=most_bytes)
        frame = _decompressor.decompressobj()
        frame.decompress(stream)  # again, as only this one tells where the frame ends
    except zstandard.ZstdError as error:
        raise DecodeError(f"a map's zstd stream is broken or above {most_bytes} bytes: {error}") from error
    if frame.unused_data:
        raise DecodeError(f"{len(frame.unused_data)} bytes follow a map's zstd stream")
    return raw


def _bits(body: io.BytesIO, count: int, name: str) -> NDArray[np.bool_]:
    size = (count + 7) // 8
    packed = body.read(size)
    if len(packed) != size:
        raise DecodeError(f"a map's {name} of {count} bits is cut after {len(packed)} bytes")
    return np.unpackbits(np.frombuffer(packed, np.uint8), count=count).astype(np.bool_)

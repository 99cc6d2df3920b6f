"""Maps without a model: the paper's zlib, and differences along a serpentine under LZMA.

Neither needs more than NumPy and the standard library; a reader takes no more memory than the grid says.
Of the general coders LZMA does best here: its adaptive bits suit noise that changes over the map, and
carry no tables (1.5 % less than zstd 19 on values, 1 % on masks).
"""

from __future__ import annotations

import io
import lzma
import zlib
from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

from .errors import DecodeError
from .map_header import MapFlag, MapHeader
from .palette import from_ranks, to_ranks
from .quantisation import HOLE, Codes

_ZLIB_LEVEL = 9
FILTERS = [{"id": lzma.FILTER_LZMA1, "preset": 9, "lc": 0, "lp": 0, "pb": 0, "dict_size": 1 << 18}]
_WORTH_TRYING = 1.02  # above the least entropy
_PLANES = 3  # bytes of a code above 255, or of its difference, which takes 17 bits
_BLOCK_ROWS, _BLOCK_COLUMNS = 4, 2


class Layout(IntFlag):
    """How a serpentine was laid; 0 is rows, differences, and a mask row by row."""

    DOWN = 1  # the walk goes along columns
    CODES = 2  # codes, not their differences
    BLOCKS = 4  # the mask in blocks


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
    """A byte that says how, two for the length of what comes next; the mask's bits, and the palette's if
    there is one; the measured cells' codes or their differences. The last two each by LZMA.
    """
    palette = b"" if used is None else np.packbits(used).tobytes()
    if used is not None:
        cells = to_ranks(cells, used)
    masks = {k: _deflated(_laid_out(cells.valid, k) + palette) for k in (Layout(0), Layout.BLOCKS)}
    layout = min(masks, key=lambda k: len(masks[k]))
    numbers = {k: _numbers(cells, k) for k in (Layout(0), Layout.DOWN, Layout.CODES)}
    entropies = {k: _entropy_bits(walked) for k, walked in numbers.items()}
    worth_trying = [k for k in numbers if entropies[k] <= _WORTH_TRYING * min(entropies.values())]
    walks = {k: _deflated(_planes(numbers[k], cells.levels)) for k in worth_trying}
    walk = min(walks, key=lambda k: len(walks[k]))
    mask = masks[layout]
    return bytes([layout | walk]) + len(mask).to_bytes(2, "little") + mask + walks[walk]


def serpentine_decode(stream: bytes, header: MapHeader) -> NDArray[np.int64]:
    """(rows, columns) codes. Raises DecodeError."""
    rows, columns, levels = header.rows, header.columns, header.levels
    layout, mask, walk_data = _split(stream)
    mask_bits = len(_laid_out(np.zeros((rows, columns), np.bool_), layout)) * 8
    body = io.BytesIO(_inflated(mask, mask_bits // 8 + levels // 8 + 1))
    valid = _from_layout(_bits(body, mask_bits, "mask"), rows, columns, layout)
    used = _bits(body, levels, "palette") if header.flags & MapFlag.PALETTE else None
    if used is not None:
        levels = int(used.sum())
    measured = _from_planes(walk_data, int(valid.sum()), levels, layout)
    if body.read():
        raise DecodeError("bytes follow a map's mask")
    if measured.size and not 0 <= measured.min() <= measured.max() < levels:
        raise DecodeError(f"differences lead outside 0..{levels - 1}")
    codes = np.full((rows, columns), HOLE, np.int64)
    turned = codes.T if layout & Layout.DOWN else codes
    walk = _serpentine(np.where(valid.T if layout & Layout.DOWN else valid, 0, HOLE))
    walk[walk != HOLE] = measured
    turned[:] = _serpentine(walk.reshape(turned.shape)).reshape(turned.shape)
    return codes if used is None else from_ranks(codes, used)


def _numbers(cells: Codes, layout: Layout) -> NDArray[np.int64]:
    """The measured cells' codes in the order of the walk, or their differences, folded to be positive."""
    walk = _serpentine(cells.codes.T if layout & Layout.DOWN else cells.codes)
    codes: NDArray[np.int64] = walk[walk != HOLE]
    if layout & Layout.CODES:
        return codes
    steps: NDArray[np.int64] = np.diff(codes, prepend=0)
    if cells.levels <= 256:
        steps = (steps + 128 & 255) - 128
    folded: NDArray[np.int64] = np.where(steps < 0, -2 * steps - 1, 2 * steps)
    return folded


def _entropy_bits(numbers: NDArray[np.int64]) -> float:
    """What an ideal coder without any context would take."""
    counts = np.bincount(numbers)
    counts = counts[counts > 0]
    return float((counts * np.log2(len(numbers) / counts)).sum())


def _planes(numbers: NDArray[np.int64], levels: int) -> bytes:
    """The numbers' low bytes, then, above 256 levels, their middle and their high ones."""
    shifts = [8 * i for i in range(_plane_count(levels))]
    return b"".join((numbers >> shift & 255).astype(np.uint8).tobytes() for shift in shifts)


def _from_planes(data: bytes, count: int, levels: int, layout: Layout) -> NDArray[np.int64]:
    planes = _plane_count(levels)
    data = _inflated(data, count * planes)
    if len(data) != count * planes:
        raise DecodeError(f"{len(data)} bytes of codes are not {planes} for each of {count} cells")
    bytes_of = np.frombuffer(data, np.uint8).reshape(planes, count).astype(np.int64)
    numbers = sum((plane << 8 * i for i, plane in enumerate(bytes_of)), np.zeros(count, np.int64))
    if layout & Layout.CODES:
        return numbers
    codes = np.cumsum(np.where(numbers & 1, -(numbers >> 1) - 1, numbers >> 1))
    return codes & 255 if planes == 1 else codes


def _plane_count(levels: int) -> int:
    return 1 if levels <= 256 else _PLANES


def _split(stream: bytes) -> tuple[Layout, bytes, bytes]:
    """A serpentine's layout, its mask's frame and its walk's."""
    if len(stream) < 3 or stream[0] & ~sum(Layout):
        raise DecodeError(f"a serpentine that begins with {stream[:3].hex() or 'nothing'} is none")
    end = 3 + int.from_bytes(stream[1:3], "little")
    return Layout(stream[0]), stream[3:end], stream[end:]


def _laid_out(valid: NDArray[np.bool_], layout: Layout) -> bytes:
    """The mask's bits in their order: row by row, or in blocks of 4 rows and 2 columns, padded by holes."""
    if not layout & Layout.BLOCKS:
        return np.packbits(valid).tobytes()
    rows, columns = valid.shape
    padded = np.pad(valid, ((0, -rows % _BLOCK_ROWS), (0, -columns % _BLOCK_COLUMNS)))
    blocks = padded.reshape(padded.shape[0] // _BLOCK_ROWS, _BLOCK_ROWS, -1, _BLOCK_COLUMNS)
    return np.packbits(blocks.transpose(0, 2, 1, 3)).tobytes()


def _from_layout(bits: NDArray[np.bool_], rows: int, columns: int, layout: Layout) -> NDArray[np.bool_]:
    if not layout & Layout.BLOCKS:
        return bits[: rows * columns].reshape(rows, columns)
    down, across = -(-rows // _BLOCK_ROWS), -(-columns // _BLOCK_COLUMNS)
    blocks = (
        bits[: down * across * 8].reshape(down, across, _BLOCK_ROWS, _BLOCK_COLUMNS).transpose(0, 2, 1, 3)
    )
    return blocks.reshape(down * _BLOCK_ROWS, across * _BLOCK_COLUMNS)[:rows, :columns]


def _code_type(levels: int) -> np.dtype[np.unsignedinteger]:
    return np.dtype(np.uint8) if levels <= 255 else np.dtype("<u2")


def _serpentine(grid: NDArray[np.int64]) -> NDArray[np.int64]:
    """The cells from left to right, then from right to left, row by row; its own inverse."""
    walk = grid.copy()
    walk[1::2] = walk[1::2, ::-1]
    return walk.reshape(-1)


def _deflated(data: bytes) -> bytes:
    return lzma.compress(data, format=lzma.FORMAT_RAW, filters=FILTERS)


def _inflated(stream: bytes, most_bytes: int) -> bytes:
    """The content of exactly one LZMA stream. Raises DecodeError for anything else."""
    reader = lzma.LZMADecompressor(format=lzma.FORMAT_RAW, filters=FILTERS)
    try:
        content = reader.decompress(stream, most_bytes + 1)
        if len(content) <= most_bytes and not reader.eof and not reader.needs_input:
            content += reader.decompress(b"", 1)
    except lzma.LZMAError as error:
        raise DecodeError(f"a map's LZMA stream is unsound: {error}") from None
    if len(content) > most_bytes or not reader.eof or reader.unused_data:
        raise DecodeError(f"a map's LZMA stream of {len(stream)} bytes does not end at {most_bytes}")
    return content


def _bits(body: io.BytesIO, count: int, name: str) -> NDArray[np.bool_]:
    size = (count + 7) // 8
    packed = body.read(size)
    if len(packed) != size:
        raise DecodeError(f"a map's {name} of {count} bits is cut after {len(packed)} bytes")
    return np.unpackbits(np.frombuffer(packed, np.uint8), count=count).astype(np.bool_)

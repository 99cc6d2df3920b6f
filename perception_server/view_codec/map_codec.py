"""Height and range maps as bytes: quantised with a bounded error, then coded without further loss."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import map_context, map_plain
from .codec_id import CodecId, codec_of
from .compiled import IS_COMPILED
from .errors import DecodeError, EncodeError
from .map_filters import closed, denoised, smoothed
from .map_header import (
    HEADER_BYTES,
    MAX_CELLS,
    MAX_CONTEXT_CELLS,
    MAX_LENGTH_M,
    MAX_SIDE,
    MapFlag,
    MapHeader,
    pack_header,
    unpack_header,
)
from .palette import used_codes
from .quantisation import LEAST_BITS, MOST_BITS, Codes, dequantise, lattice_for, quantise

PAPER_BITS = 8
_WARM_UP_CRC = 0x73B3A912
_NAMES = {
    "zlib": CodecId.MAP_ZLIB,
    "serpentine": CodecId.MAP_SERPENTINE,
    "context": CodecId.MAP_CONTEXT,
}


@dataclass(frozen=True, slots=True, eq=False)
class MapView:
    """A decoded map.

    values: (rows, columns) float32 metres, NaN in holes. max_error_m: the largest difference between a
    measured cell and what it was, denoising included. step_m: between two codes. closed: (rows, columns),
    cells that nobody measured, filled from their neighbours; no error is promised for them.
    """

    values: NDArray[np.float32]
    max_error_m: float
    step_m: float
    denoised: bool
    closed: NDArray[np.bool_]

    @property
    def altered(self) -> bool:
        """Whether more was done to the measurements than quantising them."""
        return self.denoised or bool(self.closed.any())


def encode_map(
    values: ArrayLike,
    *,
    max_error_m: float | None = None,
    bits: int | None = None,
    codec: CodecId | str | None = None,
    denoise: bool = False,
    close_gaps: bool = False,
) -> bytes:
    """A map that decodes alone.

    values: (rows, columns) metres in a kind of float, coded as float32; what is not finite is a hole.
    Quantised to `max_error_m`, or over its own range to `bits` (8, the paper's, if neither is given).
    codec: "zlib", "serpentine" or "context"; None takes the smaller of the last two, or the serpentine
    without Numba or above 65,536 cells.
    denoise: a bilateral filter first. close_gaps: the reader fills gaps of one or two cells and marks
    them. Raises EncodeError for a map or a wish that cannot be carried.
    """
    exact = _checked_map(values)
    known = exact.astype(np.float32)
    bits = _checked_fidelity(max_error_m, bits)
    codec = _checked_codec(codec)
    sent = denoised(known) if denoise else known
    lattice = lattice_for(sent[np.isfinite(sent)], max_error_m=max_error_m, bits=bits)
    cells = quantise(sent, lattice)
    flags = (MapFlag.DENOISED if denoise else MapFlag(0)) | (MapFlag.CLOSED if close_gaps else MapFlag(0))
    used = None if codec is CodecId.MAP_ZLIB or not cells.levels else used_codes(cells)
    if used is not None:
        flags |= MapFlag.PALETTE
    codec, stream = _smallest(codec, cells, used)
    header = MapHeader(
        codec,
        flags,
        known.shape[0],
        known.shape[1],
        cells.levels,
        lattice.origin_m,
        lattice.step_m,
        _achieved_error_m(exact, _measured(cells.codes, flags, lattice.origin_m, lattice.step_m)),
    )
    return pack_header(header) + stream


def decode_map(data: bytes) -> MapView:
    """The map of a message. Raises DecodeError for anything that is not one whole map."""
    data = bytes(data)
    codec = codec_of(data)
    if codec not in _NAMES.values():
        raise DecodeError(f"{codec.name} is no codec of maps")
    header = unpack_header(data)
    codes = _decode_cells(data[HEADER_BYTES:], header)
    if int(codes.max()) >= max(header.levels, 1):
        raise DecodeError(f"code {int(codes.max())} is beyond {header.levels} levels")
    values = _measured(codes, header.flags, header.origin_m, header.step_m)
    filled = np.zeros(values.shape, np.bool_)
    if header.flags & MapFlag.CLOSED:
        values, filled = closed(values)
    return MapView(values, header.max_error_m, header.step_m, bool(header.flags & MapFlag.DENOISED), filled)


def warm_up() -> None:
    """Load or compile the kernels, so that the first view does not wait, and check what they write.

    The first time takes some ten seconds, later ones less than one. Raises RuntimeError if the bytes are
    not those of every other machine, as from machine code that an older source left in Numba's cache.
    """
    cells = np.arange(20 * 24, dtype=np.int64).reshape(20, 24)
    heights = (cells * cells * 7 % 97 + cells % 24 * 9 % 31).astype(np.float32) / np.float32(64)
    heights[(cells * 5 + cells // 24) % 7 == 0] = np.nan
    message = encode_map(heights, max_error_m=0.015625, codec=CodecId.MAP_CONTEXT)
    if zlib.crc32(message) != _WARM_UP_CRC:
        raise RuntimeError(
            f"the compiled map codec writes {zlib.crc32(message):#010x}, not {_WARM_UP_CRC:#010x}: "
            f"remove {Path(__file__).with_name('__pycache__')} and start again"
        )
    decode_map(message)


def _smallest(codec: CodecId | None, cells: Codes, used: NDArray[np.bool_] | None) -> tuple[CodecId, bytes]:
    """A codec and its stream: the one asked for, or the better of two. Context mixing nearly always wins;
    where a map repeats itself exactly, the serpentine does, which looks for repetition."""
    is_large = cells.codes.size > MAX_CONTEXT_CELLS
    if codec is CodecId.MAP_CONTEXT and is_large:
        raise EncodeError(
            f"a map of {cells.codes.size} cells is too large for context mixing: "
            f"the most is {MAX_CONTEXT_CELLS}"
        )
    if codec is not None:
        return codec, _encode_cells(codec, cells, used)
    if is_large or not IS_COMPILED:
        return CodecId.MAP_SERPENTINE, _encode_cells(CodecId.MAP_SERPENTINE, cells, used)
    both = [(c, _encode_cells(c, cells, used)) for c in (CodecId.MAP_CONTEXT, CodecId.MAP_SERPENTINE)]
    return min(both, key=lambda coded: len(coded[1]))


def _encode_cells(codec: CodecId, cells: Codes, used: NDArray[np.bool_] | None) -> bytes:
    if not cells.levels:
        return b""
    if codec is CodecId.MAP_ZLIB:
        return map_plain.zlib_encode(cells)
    if codec is CodecId.MAP_SERPENTINE:
        return map_plain.serpentine_encode(cells, used)
    return map_context.encode_cells(cells, used)


def _decode_cells(stream: bytes, header: MapHeader) -> NDArray[np.int64]:
    if not header.levels:
        if stream:
            raise DecodeError(f"{len(stream)} bytes follow a map of holes alone")
        return np.full((header.rows, header.columns), -1, np.int64)
    if header.codec is CodecId.MAP_ZLIB:
        return map_plain.zlib_decode(stream, header)
    if header.codec is CodecId.MAP_SERPENTINE:
        return map_plain.serpentine_decode(stream, header)
    return map_context.decode_cells(stream, header)


def _measured(
    codes: NDArray[np.int64], flags: MapFlag, origin_m: float, step_m: float
) -> NDArray[np.float32]:
    """The measured cells as the reader has them, NaN elsewhere."""
    values = dequantise(codes, origin_m, step_m)
    return smoothed(values, step_m) if flags & MapFlag.DENOISED else values


def _achieved_error_m(values: NDArray[np.float64], decoded: NDArray[np.float32]) -> float:
    """The largest difference on measured cells, rounded up to a float32."""
    off = np.abs(values - decoded)
    worst = float(np.nanmax(off)) if np.isfinite(off).any() else 0.0
    error = np.float32(worst)
    return float(error if float(error) >= worst else np.nextafter(error, np.float32(np.inf)))


def _checked_map(values: ArrayLike) -> NDArray[np.float64]:
    """The map with NaN for whatever is no length."""
    array = np.asarray(values)
    if array.ndim != 2 or array.dtype.kind != "f":  # whole numbers may well be millimetres
        raise EncodeError(f"a map is (rows, columns) float32, not {array.ndim} axes of {array.dtype}")
    rows, columns = array.shape
    if not (1 <= rows <= MAX_SIDE and 1 <= columns <= MAX_SIDE and rows * columns <= MAX_CELLS):
        raise EncodeError(f"a map of {rows} x {columns} cells is outside 1..{MAX_CELLS} cells")
    known = np.where(np.isfinite(array), array, np.nan).astype(np.float64)
    if np.any(np.abs(known) > MAX_LENGTH_M):
        raise EncodeError(f"a map's values must be within ±{MAX_LENGTH_M:g} m")
    return known


def _checked_fidelity(max_error_m: float | None, bits: int | None) -> int | None:
    """The bits to quantise to; None if by max_error_m."""
    if max_error_m is not None:
        if bits is not None:
            raise EncodeError(f"max_error_m = {max_error_m} and bits = {bits}: give one of the two")
        if not 0 < max_error_m < float("inf"):
            raise EncodeError(f"max_error_m = {max_error_m} must be above 0")
        return None
    bits = PAPER_BITS if bits is None else bits
    if bits not in range(LEAST_BITS, MOST_BITS + 1):
        raise EncodeError(f"bits = {bits} must be within {LEAST_BITS}..{MOST_BITS}")
    return bits


def _checked_codec(codec: CodecId | str | None) -> CodecId | None:
    if codec is None:
        return None
    chosen = _NAMES.get(codec) if isinstance(codec, str) else codec
    if chosen is None or chosen not in _NAMES.values():
        raise EncodeError(f"codec = {codec!r} is none of {', '.join(_NAMES)}")
    return chosen

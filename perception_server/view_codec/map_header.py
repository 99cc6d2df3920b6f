"""What every encoded map begins with: its codec, its grid and what its codes mean."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import IntFlag

from .codec_id import CodecId
from .errors import DecodeError

MAX_CELLS = 1 << 17  # 362 x 362; bounds what a message of a few bytes can make a reader compute
MAX_CONTEXT_CELLS = 1 << 16  # where each cell may cost 8 µs: half a second of noise at 16 bits
MAX_SIDE = 4096
MAX_LENGTH_M = 1e9  # of a value to send; what comes may lie ten times as far
MAX_LEVELS = 65535  # 65535 itself is a hole where holes have a code
_HEADER = struct.Struct("<BBHHHfff")
HEADER_BYTES = _HEADER.size


class MapFlag(IntFlag):
    """What was done to a map besides quantising it, and how its codes are to be read."""

    DENOISED = 1  # a bilateral filter went over the values
    CLOSED = 2  # the reader fills narrow gaps and marks the cells
    PALETTE = 4  # codes are ranks among the used codes, which are sent


@dataclass(frozen=True, slots=True)
class MapHeader:
    """A cell of code k is at origin_m + k * step_m. `levels` codes exist; 0 if all cells are holes.

    max_error_m is the largest difference between a measured cell and its decoded value.
    """

    codec: CodecId
    flags: MapFlag
    rows: int
    columns: int
    levels: int
    origin_m: float
    step_m: float
    max_error_m: float


def pack_header(header: MapHeader) -> bytes:
    """20 bytes, little endian."""
    return _HEADER.pack(
        header.codec,
        header.flags,
        header.rows,
        header.columns,
        header.levels,
        header.origin_m,
        header.step_m,
        header.max_error_m,
    )


def unpack_header(data: bytes) -> MapHeader:
    """Raises DecodeError for a short message and for fields outside their bounds."""
    if len(data) < HEADER_BYTES:
        raise DecodeError(f"a map of {len(data)} bytes is shorter than its header of {HEADER_BYTES}")
    codec, flags, rows, columns, levels, *lengths_m = _HEADER.unpack_from(data)
    if flags & ~sum(MapFlag):
        raise DecodeError(f"map flags 0x{flags:02x} hold bits that mean nothing")
    if not (1 <= rows <= MAX_SIDE and 1 <= columns <= MAX_SIDE and rows * columns <= MAX_CELLS):
        raise DecodeError(f"a map of {rows} x {columns} cells is outside 1..{MAX_CELLS} cells")
    if not all(map(math.isfinite, lengths_m)) or lengths_m[1] < 0 or lengths_m[2] < 0:
        raise DecodeError(f"a map's origin, step and error of {lengths_m} m are no lengths")
    if abs(lengths_m[0]) + levels * lengths_m[1] > 10 * MAX_LENGTH_M:
        raise DecodeError(
            f"a map of {levels} steps of {lengths_m[1]} m from {lengths_m[0]} m is too far away"
        )
    return MapHeader(CodecId(codec), MapFlag(flags), rows, columns, levels, *lengths_m)

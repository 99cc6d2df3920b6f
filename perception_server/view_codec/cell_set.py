"""The part that clouds and octrees share: a set of cells as its size and a coded octree."""

from __future__ import annotations

import struct

import numpy as np

from .errors import DecodeError, EncodeError
from .occupancy import MAX_CELLS, MAX_DEPTH, Cells, cells_of, codes_from_bytes, codes_of, levels_of
from .zstd_frame import read_zstd_frame, zstd_frame

_SIZE = struct.Struct(">BI")  # levels below the root; cells


def encode_cells(cells: Cells) -> bytes:
    """A set of cells; an index is below 2**MAX_DEPTH. Raises EncodeError for more than MAX_CELLS."""
    codes = codes_of(cells)
    if len(codes) > MAX_CELLS:
        raise EncodeError(f"{len(codes)} occupied cells are above {MAX_CELLS}: crop, or code coarser")
    depth = int(cells.max(initial=0)).bit_length()
    size = _SIZE.pack(depth, len(codes))
    return size + zstd_frame([level.tobytes() for level in levels_of(codes, depth)]) if depth else size


def decode_cells(data: bytes) -> Cells:
    """The cells in the order of their codes. Raises DecodeError."""
    if len(data) < _SIZE.size:
        raise DecodeError(f"a set of cells in {len(data)} bytes lacks its size of {_SIZE.size} bytes")
    depth, count = _SIZE.unpack_from(data)
    if depth > MAX_DEPTH or count > MAX_CELLS:
        raise DecodeError(f"{count} cells at depth {depth} are above {MAX_CELLS} at {MAX_DEPTH}")
    coded = data[_SIZE.size :]
    if depth == 0:
        if coded or count > 1:
            raise DecodeError(f"{count} cells and {len(coded)} bytes of octree at depth 0")
        return np.zeros((count, 3), np.int64)
    return cells_of(codes_from_bytes(read_zstd_frame(coded, count * depth), depth, count))

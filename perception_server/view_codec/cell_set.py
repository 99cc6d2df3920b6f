"""The part that clouds and octrees share: a set of cells as its size and a coded octree."""

from __future__ import annotations

import struct

import numpy as np

from .codec_id import CodecId
from .compiled import IS_COMPILED
from .errors import DecodeError, EncodeError
from .occupancy import MAX_CELLS, MAX_DEPTH, Cells, cells_of, codes_from_bytes, codes_of, levels_of
from .occupancy_context import MAX_NODES, decode_occupancy, encode_occupancy
from .zstd_frame import read_zstd_frame, zstd_frame

_SIZE = struct.Struct("<BI")  # levels below the root; cells


def encode_cells(cells: Cells, plain: CodecId, small: CodecId, header: bytes, wish: CodecId | None) -> bytes:
    """A message: codec, header, cells; under `wish`, or under the smaller of the two; without Numba
    under the plain one, as the other would take a hundred times as long.

    An index is below 2**MAX_DEPTH. Raises EncodeError for more than MAX_CELLS, and for more nodes than
    the wished codec takes.
    """
    codes = codes_of(cells)
    if len(codes) > MAX_CELLS:
        raise EncodeError(f"{len(codes)} occupied cells are above {MAX_CELLS}: crop, or code coarser")
    depth = int(cells.max(initial=0)).bit_length()
    levels = levels_of(codes, depth)
    size = _SIZE.pack(depth, len(codes))
    messages = []
    if wish is small or (wish is None and IS_COMPILED):
        coded = encode_occupancy(levels)
        messages += [bytes([small]) + header + size + coded] if coded is not None else []
    if wish is small and not messages:
        raise EncodeError(f"{sum(map(len, levels))} nodes are above {MAX_NODES}, which {small.name} takes")
    if wish is not small:
        coded = zstd_frame([level.tobytes() for level in levels]) if depth else b""
        messages.append(bytes([plain]) + header + size + coded)
    return min(messages, key=len)


def decode_cells(data: bytes, mixed: bool) -> Cells:
    """The cells in the order of their codes; `mixed`: the codec is the small one. Raises DecodeError."""
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
    if mixed:
        return cells_of(decode_occupancy(coded, depth, count))
    return cells_of(codes_from_bytes(read_zstd_frame(coded, count * depth), depth, count))

"""Maps by context mixing: hole mask, palette and values in one range-coded stream."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .binary_coder import check_end, code_bit, decoder, encoded_bytes, encoder
from .cell_values import code_cell_values
from .compiled import Ints, compiled, ints
from .context_mixing import FRESH, TABLES, Tables, learned
from .errors import DecodeError
from .hole_mask import code_hole_mask
from .map_header import MAX_CONTEXT_CELLS, MapFlag, MapHeader
from .palette import from_ranks, to_ranks
from .quantisation import HOLE, Codes

_CAPACITY_BYTES = 4096  # besides 8 bytes a cell, which is more than the 50 decisions of a cell can take
_LEVEL_BITS = 16
_PALETTE_LIMIT = 30


def encode_cells(cells: Codes, used: NDArray[np.bool_] | None) -> bytes:
    """The stream of a map with at least one measured cell. used: its palette, if it has one."""
    rows, columns = cells.codes.shape
    coder, data = encoder(8 * rows * columns + cells.levels + _CAPACITY_BYTES)
    valid = code_hole_mask(coder, data, cells.valid, rows, columns)
    if used is not None:
        _code_palette(coder, data, ints(used), cells.levels)
        cells = to_ranks(cells, used)
    first = int(cells.codes[valid][0])
    _code_number(coder, data, first)
    code_cell_values(coder, data, cells.codes, cells.levels, first)
    return encoded_bytes(coder, data)


def decode_cells(stream: bytes, header: MapHeader) -> NDArray[np.int64]:
    """(rows, columns) codes. Raises DecodeError."""
    if header.rows * header.columns > MAX_CONTEXT_CELLS:
        raise DecodeError(f"{header.rows} x {header.columns} cells are more than {MAX_CONTEXT_CELLS}")
    coder, data = decoder(stream)
    valid = code_hole_mask(coder, data, None, header.rows, header.columns)
    if not valid.any():
        raise DecodeError(f"a map of {header.levels} levels has no measured cell")
    used, levels = None, header.levels
    if header.flags & MapFlag.PALETTE:
        used = _code_palette(coder, data, ints(np.zeros(levels)), levels)
        levels = int(used.sum())
        if not levels:
            raise DecodeError("a palette holds no code")
    first = _code_number(coder, data, 0)
    if first >= levels:
        raise DecodeError(f"the first code {first} is beyond {levels} levels")
    codes = code_cell_values(coder, data, np.where(valid, 0, HOLE), levels, first)
    check_end(coder, data)
    return codes if used is None else from_ranks(codes, used)


def _code_palette(coder: Ints, data: NDArray[np.uint8], used: Ints, levels: int) -> NDArray[np.bool_]:
    """Write which codes occur, or read it."""
    _code_used(coder, data, used, levels, TABLES, ints(np.full(16, FRESH)))
    return np.asarray(used, dtype=np.bool_)


@compiled
def _code_used(
    coder: Ints, data: NDArray[np.uint8], used: Ints, levels: int, tables: Tables, slots: Ints
) -> None:
    """One bit for each code, told by the four before it."""
    before = 0
    for code in range(levels):
        slot = slots[before]
        bit = code_bit(coder, data, used[code], max(slot >> 16, 1))
        slots[before] = learned(tables.rate, slot, bit, _PALETTE_LIMIT)
        used[code] = bit
        before = (before << 1 | bit) & 15


@compiled
def _code_number(coder: Ints, data: NDArray[np.uint8], number: int) -> int:
    """Write 16 bits as they are, or read them."""
    result = 0
    for shift in range(_LEVEL_BITS - 1, -1, -1):
        result = result << 1 | code_bit(coder, data, number >> shift & 1, 1 << 15)
    return result

"""The scan of a baseline JPEG: entropy-coded bytes to quantised coefficients and back.

Coefficients lie flat, 64 to a block in zigzag order, blocks in rows, component after component.
A layout is MCUs, MCUs across, components, then for each its blocks across and down an MCU, its columns
of blocks, its first block and its pair of Huffman tables. Source: ITU-T T.81, annex F.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .compiled import Ints, compiled, ints, octets
from .jpeg_file import JpegFrame
from .jpeg_tables import SYMBOLS, HuffmanTables, reading_tables, writing_tables

LAYOUT_HEADER, LAYOUT_SIZE = 3, 5
MOST_DC_BITS, MOST_AC_BITS = 11, 10  # of a baseline file's 8-bit samples
MOST_AC = (1 << MOST_AC_BITS) - 1
LEAST_DC, MOST_DC = -1024, 1023  # so that two of them never differ by more than 11 bits
_POSITION, _HELD, _BITS, _UNSOUND = range(4)  # of a bit reader or writer


class UnsoundScanError(Exception):
    """Entropy-coded bytes that are not exactly the blocks their header declares."""


def layout_of(frame: JpegFrame, pairs: list[int]) -> Ints:
    """The layout of a frame whose components use the Huffman tables `pairs`."""
    flat, first = [frame.mcus, frame.mcus_across, len(frame.components)], 0
    for part, pair in zip(frame.components, pairs, strict=True):
        flat += [part.across, part.down, part.columns, first, pair]
        first += part.blocks
    return ints(flat)


def read_scan(scan: bytes, layout: Ints, tables: HuffmanTables, restart_mcus: int, blocks: int) -> Ints:
    """The quantised coefficients of a whole scan. Raises UnsoundScanError."""
    coefficients = ints(np.zeros(64 * blocks))
    lookup, reader, last_dc = reading_tables(tables), ints([0] * 4), ints([0] * 3)
    if not _read_mcus(octets(scan), lookup, layout, restart_mcus, coefficients, reader, last_dc):
        raise UnsoundScanError(f"the scan of {len(scan)} bytes is not whole, or not followed by its end")
    return coefficients


def count_symbols(coefficients: Ints, layout: Ints) -> list[list[int]]:
    """How often each symbol of DC 0, AC 0, DC 1, AC 1 occurs."""
    counts = ints(np.zeros(4 * SYMBOLS))
    _write_mcus(coefficients, layout, counts, True, octets(b""), ints([0] * 3), ints([0] * 3))
    return [[int(n) for n in counts[at : at + SYMBOLS]] for at in range(0, 4 * SYMBOLS, SYMBOLS)]


def write_scan(coefficients: Ints, layout: Ints, tables: HuffmanTables) -> bytes:
    """The coefficients as one scan without restart markers, filled up with ones; tables must hold all."""
    codes = writing_tables(tables)
    bits = sum(
        count * ((int(codes[kind * SYMBOLS + symbol]) & 31) + (symbol & 15))
        for kind, counts in enumerate(count_symbols(coefficients, layout))
        for symbol, count in enumerate(counts)
        if count
    )
    data = octets(bytes(2 * (bits // 8 + 1)))  # each byte may be stuffed
    used = _write_mcus(coefficients, layout, codes, False, data, ints([0] * 3), ints([0] * 3))
    return bytes(data[:used])


@compiled
def _next_bit(reader: Ints, scan: NDArray[np.uint8]) -> int:
    if reader[_BITS] == 0:
        position = reader[_POSITION]
        if position >= len(scan) or (
            scan[position] == 0xFF and (position + 1 >= len(scan) or scan[position + 1] != 0)
        ):
            reader[_UNSOUND] = 1
            return 0
        reader[_HELD] = scan[position]
        reader[_POSITION] = position + (2 if scan[position] == 0xFF else 1)
        reader[_BITS] = 8
    reader[_BITS] -= 1
    return (reader[_HELD] >> reader[_BITS]) & 1  # type: ignore[no-any-return]


@compiled
def _next_symbol(reader: Ints, scan: NDArray[np.uint8], tables: Ints, table: int) -> int:
    code = 0
    for length in range(16):
        code = code << 1 | _next_bit(reader, scan)
        if code < tables[table + length]:
            return tables[table + 32 + tables[table + 16 + length] + code]  # type: ignore[no-any-return]
    reader[_UNSOUND] = 1
    return 0


@compiled
def _next_value(reader: Ints, scan: NDArray[np.uint8], bits: int) -> int:
    """A signed number of `bits` bits (T.81, F.2.2.1)."""
    value = 0
    for _ in range(bits):
        value = value << 1 | _next_bit(reader, scan)
    return value if bits == 0 or value >> (bits - 1) else value - (1 << bits) + 1


@compiled
def _read_block(
    reader: Ints, scan: NDArray[np.uint8], tables: Ints, table: int, coefficients: Ints, at: int
) -> None:
    """One block; its DC difference is left in the place of its DC."""
    bits = _next_symbol(reader, scan, tables, table)
    if bits > MOST_DC_BITS:
        reader[_UNSOUND] = 1
    coefficients[at] = _next_value(reader, scan, bits & 15)
    k = 1
    while k < 64 and not reader[_UNSOUND]:
        symbol = _next_symbol(reader, scan, tables, table + 288)
        run = symbol >> 4
        bits = symbol & 15
        k += run
        if bits == 0:
            if run == 15:
                k += 1
                if k > 63:
                    reader[_UNSOUND] = 1
                continue
            if run != 0:
                reader[_UNSOUND] = 1
            return
        if k > 63 or bits > MOST_AC_BITS:
            reader[_UNSOUND] = 1
            return
        coefficients[at + k] = _next_value(reader, scan, bits)
        k += 1


@compiled
def _restart(reader: Ints, scan: NDArray[np.uint8], number: int) -> None:
    """Step over restart marker `number` (0..7), which lies on a byte boundary behind ones."""
    position = reader[_POSITION]
    marked = position + 1 < len(scan) and scan[position] == 0xFF and scan[position + 1] == 0xD0 + number
    if not marked:
        reader[_UNSOUND] = 1
    reader[_POSITION] = position + 2
    reader[_BITS] = 0


@compiled
def _block_at(layout: Ints, at: int, mcu: int, inside: int) -> int:
    """Where the coefficients start of block `inside` an MCU, of the component described at `at`."""
    across = layout[at]
    row = mcu // layout[1] * layout[at + 1] + inside // across
    column = mcu % layout[1] * across + inside % across
    return 64 * (layout[at + 3] + row * layout[at + 2] + column)  # type: ignore[no-any-return]


@compiled
def _read_mcus(
    scan: NDArray[np.uint8],
    tables: Ints,
    layout: Ints,
    restart_mcus: int,
    coefficients: Ints,
    reader: Ints,
    last_dc: Ints,
) -> bool:
    """Fill `coefficients` from a scan; False if it is not exactly what the layout declares."""
    for mcu in range(layout[0]):
        if restart_mcus and mcu and mcu % restart_mcus == 0:
            _restart(reader, scan, (mcu // restart_mcus - 1) % 8)
            last_dc[0] = last_dc[1] = last_dc[2] = 0
        for part in range(layout[2]):
            at = LAYOUT_HEADER + part * LAYOUT_SIZE
            for inside in range(layout[at] * layout[at + 1]):
                block = _block_at(layout, at, mcu, inside)
                _read_block(reader, scan, tables, layout[at + 4] * 576, coefficients, block)
                last_dc[part] += coefficients[block]
                coefficients[block] = last_dc[part]
                if reader[_UNSOUND] or not LEAST_DC <= last_dc[part] <= MOST_DC:
                    return False
    return reader[_POSITION] == len(scan)  # type: ignore[no-any-return]


@compiled
def _put(writer: Ints, data: NDArray[np.uint8], value: int, bits: int) -> None:
    """Append the low `bits` bits of `value`, stuffing a zero behind each byte of ones."""
    writer[_HELD] = writer[_HELD] << bits | (value & ((1 << bits) - 1))
    writer[_BITS] += bits
    while writer[_BITS] >= 8:
        writer[_BITS] -= 8
        byte = (writer[_HELD] >> writer[_BITS]) & 0xFF
        data[writer[_POSITION]] = byte
        writer[_POSITION] += 2 if byte == 0xFF else 1
    writer[_HELD] &= (1 << writer[_BITS]) - 1


@compiled
def _put_symbol(
    codes: Ints, counting: bool, at: int, value: int, bits: int, writer: Ints, data: NDArray[np.uint8]
) -> None:
    """Count a symbol, or write its code and the `bits` bits of the number that follows it."""
    if counting:
        codes[at] += 1
    else:
        _put(writer, data, codes[at] >> 5, codes[at] & 31)
        _put(writer, data, value if value >= 0 else value - 1, bits)


@compiled
def _bit_length(value: int) -> int:
    magnitude = abs(value)
    bits = 0
    while magnitude >> bits:
        bits += 1
    return bits


@compiled
def _write_mcus(
    coefficients: Ints,
    layout: Ints,
    codes: Ints,
    counting: bool,
    data: NDArray[np.uint8],
    writer: Ints,
    last_dc: Ints,
) -> int:
    """Write all blocks and return the bytes used; or, counting, count their symbols in `codes`."""
    for mcu in range(layout[0]):
        for part in range(layout[2]):
            at = LAYOUT_HEADER + part * LAYOUT_SIZE
            table = layout[at + 4] * 512
            for inside in range(layout[at] * layout[at + 1]):
                block = _block_at(layout, at, mcu, inside)
                change = coefficients[block] - last_dc[part]
                last_dc[part] = coefficients[block]
                bits = _bit_length(change)
                _put_symbol(codes, counting, table + bits, change, bits, writer, data)
                run = 0
                for k in range(1, 64):
                    value = coefficients[block + k]
                    if value == 0:
                        run += 1
                        continue
                    while run > 15:
                        _put_symbol(codes, counting, table + 256 + 0xF0, 0, 0, writer, data)
                        run -= 16
                    bits = _bit_length(value)
                    _put_symbol(codes, counting, table + 256 + (run << 4) + bits, value, bits, writer, data)
                    run = 0
                if run:
                    _put_symbol(codes, counting, table + 256, 0, 0, writer, data)
    if not counting and writer[_BITS]:
        _put(writer, data, 0xFF, 8 - writer[_BITS])
    return writer[_POSITION]  # type: ignore[no-any-return]

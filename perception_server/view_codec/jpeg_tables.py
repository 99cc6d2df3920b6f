"""JPEG's standard tables, and Huffman tables made for one picture.

A table is 16 bytes, how many codes there are of each length 1..16, then the symbols in the order of
their codes: as in a DHT segment. Source: ITU-T T.81, annexes C and K.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from .compiled import Ints, ints

DC, AC = 0, 1
SYMBOLS = 256
LONGEST_CODE = 16
LOOKUP_SIZE = 2 * LONGEST_CODE + SYMBOLS  # of one table as the kernels read it


class UnsoundTableError(Exception):
    """Bytes that are no Huffman table of a baseline file."""


@dataclass(frozen=True, slots=True)
class HuffmanTables:
    """The tables 0 (luma) and 1 (chroma) of a scan; an empty one is not there."""

    dc: tuple[bytes, bytes]
    ac: tuple[bytes, bytes]

    @classmethod
    def none(cls) -> HuffmanTables:
        """What a file has before its first DHT segment."""
        return cls((b"", b""), (b"", b""))

    def with_segment(self, body: bytes) -> HuffmanTables:
        """With the tables of a DHT segment's body. Raises UnsoundTableError."""
        tables, position = self, 0
        while position < len(body):
            selector, counts = body[position], body[position + 1 : position + 17]
            end = position + 17 + sum(counts)
            table = body[position + 1 : end]
            if selector not in (0x00, 0x01, 0x10, 0x11):
                raise UnsoundTableError(f"Huffman table 0x{selector:02x} is not one of a baseline file")
            if end > len(body):
                raise UnsoundTableError("a Huffman table ends behind its segment")
            check_table(table)
            tables = tables._with(selector >> 4, selector & 1, table)
            position = end
        return tables

    def segments(self, pairs: int) -> list[bytes]:
        """The bodies of the DHT segments of the first `pairs` pairs, in the order libjpeg writes them."""
        return [
            bytes([kind << 4 | number]) + tables[number]
            for number in range(pairs)
            for kind, tables in ((DC, self.dc), (AC, self.ac))
        ]

    def _with(self, kind: int, number: int, table: bytes) -> HuffmanTables:
        old = self.ac if kind == AC else self.dc
        pair = (table, old[1]) if number == 0 else (old[0], table)
        return replace(self, ac=pair) if kind == AC else replace(self, dc=pair)


@dataclass(frozen=True, slots=True)
class StandardTables:
    """Annex K: quantisation in zigzag order (luma, chroma) and Huffman tables."""

    quantisation: tuple[bytes, bytes]
    huffman: HuffmanTables


def check_table(table: bytes) -> None:
    """Raise UnsoundTableError for codes that overlap, and for the code of all ones, which is reserved."""
    room = 1
    for count in table[:LONGEST_CODE]:
        room = 2 * room - count
        if room < 0:
            raise UnsoundTableError("a Huffman table has more codes of a length than there are")
    symbols = table[LONGEST_CODE:]
    if len(table) < LONGEST_CODE or len(symbols) != sum(table[:LONGEST_CODE]) or room < 1:
        raise UnsoundTableError("a Huffman table is not as long as its counts, or uses the code of all ones")
    if not symbols or len(set(symbols)) != len(symbols):
        raise UnsoundTableError("a Huffman table is empty or has a symbol twice")


def reading_tables(tables: HuffmanTables) -> Ints:
    """DC 0, AC 0, DC 1, AC 1 for decoding: per length the first code past it, an offset, the symbols."""
    flat: list[int] = []
    for table in (tables.dc[0], tables.ac[0], tables.dc[1], tables.ac[1]):
        ends, offsets, code, used = [], [], 0, 0
        for count in table[:LONGEST_CODE].ljust(LONGEST_CODE, b"\0"):
            offsets.append(used - code)
            code, used = code + count, used + count
            ends.append(code)
            code <<= 1
        flat += ends + offsets + list(table[LONGEST_CODE:].ljust(SYMBOLS, b"\0"))
    return ints(flat)


def writing_tables(tables: HuffmanTables) -> Ints:
    """DC 0, AC 0, DC 1, AC 1 for encoding: per symbol its code << 5 | length, 0 where it has none."""
    flat = [0] * (4 * SYMBOLS)
    for place, table in enumerate((tables.dc[0], tables.ac[0], tables.dc[1], tables.ac[1])):
        code, symbols = 0, iter(table[LONGEST_CODE:])
        for length, count in enumerate(table[:LONGEST_CODE], 1):
            for _ in range(count):
                flat[place * SYMBOLS + next(symbols)] = code << 5 | length
                code += 1
            code <<= 1
    return ints(flat)


def fitted_table(counts: list[int]) -> bytes:
    """The Huffman table with the fewest bits for symbols that occur `counts` times.

    Source: T.81, K.2 (a reserved symbol takes the code of all ones; codes are held to 16 bits).
    """
    weights = {symbol: count for symbol, count in enumerate(counts) if count} or {0: 1}
    lengths = _code_lengths([*weights.values(), 0])
    histogram = [0] * (max(lengths) + LONGEST_CODE + 1)
    for length in lengths:
        histogram[length] += 1
    for length in range(len(histogram) - 1, LONGEST_CODE, -1):
        while histogram[length]:
            shorter = next(i for i in range(length - 2, 0, -1) if histogram[i])
            histogram[length] -= 2
            histogram[length - 1] += 1
            histogram[shorter + 1] += 2
            histogram[shorter] -= 1
    longest = next(i for i in range(LONGEST_CODE, 0, -1) if histogram[i])
    histogram[longest] -= 1  # the reserved one
    ranked = sorted(zip(lengths, weights, strict=False))
    return bytes(histogram[1 : LONGEST_CODE + 1]) + bytes(symbol for _, symbol in ranked)


def _code_lengths(weights: list[int]) -> list[int]:
    """Lengths of a Huffman code; the last symbol gets one of the longest."""
    lengths = [0] * len(weights)
    groups = [(weight, -place, [place]) for place, weight in enumerate(weights)]
    while len(groups) > 1:
        groups.sort(reverse=True)
        first, second = groups.pop(), groups.pop()
        members = first[2] + second[2]
        for place in members:
            lengths[place] += 1
        groups.append((first[0] + second[0], min(first[1], second[1]), members))
    return lengths


_LUMA_STEPS = bytes.fromhex(
    "100b0c0e0c0a100e0d0e1211101318281a181616183123251d283a333d3c3933383740485c4e404457453738506d5157"
    "5f626768673e4d71797064785c656763"
)
_CHROMA_STEPS = bytes.fromhex("1112121815182f1a1a2f634238426363") + b"\x63" * 48
_LUMA_DC = bytes.fromhex("00010501010101010100000000000000000102030405060708090a0b")
_CHROMA_DC = bytes.fromhex("00030101010101010101010000000000000102030405060708090a0b")
_LUMA_AC = bytes.fromhex(
    "0002010303020403050504040000017d01020300041105122131410613516107227114328191a1082342b1c11552d1f0"
    "2433627282090a161718191a25262728292a3435363738393a434445464748494a535455565758595a63646566676869"
    "6a737475767778797a838485868788898a92939495969798999aa2a3a4a5a6a7a8a9aab2b3b4b5b6b7b8b9bac2c3c4c5"
    "c6c7c8c9cad2d3d4d5d6d7d8d9dae1e2e3e4e5e6e7e8e9eaf1f2f3f4f5f6f7f8f9fa"
)
_CHROMA_AC = bytes.fromhex(
    "00020102040403040705040400010277000102031104052131061241510761711322328108144291a1b1c109233352f0"
    "156272d10a162434e125f11718191a262728292a35363738393a434445464748494a535455565758595a636465666768"
    "696a737475767778797a82838485868788898a92939495969798999aa2a3a4a5a6a7a8a9aab2b3b4b5b6b7b8b9bac2c3"
    "c4c5c6c7c8c9cad2d3d4d5d6d7d8d9dae2e3e4e5e6e7e8e9eaf2f3f4f5f6f7f8f9fa"
)
STANDARD_TABLES = StandardTables(
    (_LUMA_STEPS, _CHROMA_STEPS), HuffmanTables((_LUMA_DC, _CHROMA_DC), (_LUMA_AC, _CHROMA_AC))
)

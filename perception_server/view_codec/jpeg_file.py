"""A baseline JPEG taken apart into its header and its scan, and put together again.

What is not here is left alone by our caller: progressive, arithmetic-coded, lossless and 12-bit files,
several scans, four components, 16-bit quantisation tables. Source: ITU-T T.81, annexes B and K.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

from .errors import DecodeError
from .jpeg_tables import STANDARD_TABLES, HuffmanTables

SOI = b"\xff\xd8"
EOI = b"\xff\xd9"
_SOF0, _DHT, _SOS, _DQT, _DRI, _COM = 0xC0, 0xC4, 0xDA, 0xDB, 0xDD, 0xFE
_APPLICATION = range(0xE0, 0xF0)
_ALL_COEFFICIENTS = b"\x00\x3f\x00"  # of a scan: spectral selection 0..63, no successive approximation
_KEPT = (_SOF0, _DQT, _COM, *_APPLICATION)
BLOCK = 8  # pixels along a side


class NotBaselineError(Exception):
    """A file, sound or not, that is outside what is taken apart here."""


@dataclass(frozen=True, slots=True)
class Component:
    """One colour plane: its blocks per MCU, and its whole size in blocks, padding included."""

    identifier: int
    across: int
    down: int
    columns: int
    rows: int
    steps: bytes  # quantisation, 64 in zigzag order, none 0
    huffman: int = 0  # which pair of Huffman tables: 0 or 1

    @property
    def blocks(self) -> int:
        """How many 8x8 blocks the scan holds of this component."""
        return self.columns * self.rows


@dataclass(frozen=True, slots=True)
class JpegFrame:
    """What the header says about the scan; MCUs are left to right, then top to bottom."""

    width: int
    height: int
    components: tuple[Component, ...]
    mcus: int
    mcus_across: int

    @property
    def blocks(self) -> int:
        """Blocks of all components."""
        return sum(component.blocks for component in self.components)

    @property
    def pairs(self) -> int:
        """How many pairs of Huffman tables a plain file has: luma, chroma."""
        return min(len(self.components), 2)

    @property
    def standard_pairs(self) -> list[int]:
        """The pair of Huffman tables of each component in a plain file."""
        return [min(number, 1) for number in range(len(self.components))]


@dataclass(frozen=True, slots=True)
class JpegFile:
    """A baseline file in parts.

    header: the segments from behind SOI to before SOS, without Huffman tables and restart intervals.
    tables: the Huffman tables the scan was written with.
    scan: the entropy-coded bytes, stuffing and restart markers included, EOI not.
    """

    header: bytes
    frame: JpegFrame
    tables: HuffmanTables
    restart_mcus: int
    scan: bytes


def read_jpeg(data: bytes) -> JpegFile:
    """Take a file apart. Raises NotBaselineError or UnsoundTableError for what is outside."""
    if not data.startswith(SOI) or not data.endswith(EOI):
        raise NotBaselineError("the bytes do not start with SOI and end with EOI")
    position, kept, tables, restart_mcus = len(SOI), [], HuffmanTables.none(), 0
    while True:
        marker, body, end = _segment(data, position)
        if marker in _KEPT:
            kept.append(data[position:end])
        elif marker == _DHT:
            tables = tables.with_segment(body)
        elif marker == _DRI and len(body) == 2:
            restart_mcus = int.from_bytes(body, "big")
        elif marker == _SOS:
            break
        else:
            raise NotBaselineError(f"marker 0x{marker:02x} is not one of a baseline file")
        position = end
    header = b"".join(kept)
    frame = _with_scan(read_header(header), body)
    for number in {component.huffman for component in frame.components}:
        if not (tables.dc[number] and tables.ac[number]):
            raise NotBaselineError(f"the scan's Huffman tables {number} are missing")
    return JpegFile(header, frame, tables, restart_mcus, data[end : -len(EOI)])


def write_jpeg(header: bytes, frame: JpegFrame, scan: bytes, tables: HuffmanTables) -> bytes:
    """A plain baseline file: `header`, the Huffman tables, one scan of all components."""
    selectors = (
        bytes([part.identifier, 0x11 * pair])
        for part, pair in zip(frame.components, frame.standard_pairs, strict=True)
    )
    start = bytes([len(frame.components)]) + b"".join(selectors) + _ALL_COEFFICIENTS
    segments = (_wrap(_DHT, body) for body in tables.segments(frame.pairs))
    return b"".join([SOI, header, *segments, _wrap(_SOS, start), scan, EOI])


def plain_header(width: int, height: int, sampling: tuple[int, int] | None, quality: int) -> bytes:
    """The header that libjpeg and OpenCV write: JFIF 1.1, Annex K's quantisation tables scaled.

    sampling: luma blocks across and down per MCU; None for a grey picture.
    """
    grey = sampling is None
    across, down = sampling or (1, 1)
    parts = [bytes([1, across << 4 | down, 0])] + ([] if grey else [b"\x02\x11\x01", b"\x03\x11\x01"])
    frame = b"\x08" + height.to_bytes(2, "big") + width.to_bytes(2, "big") + bytes([len(parts)])
    jfif = b"JFIF\x00\x01\x01\x00\x00\x01\x00\x01\x00\x00"
    tables = [bytes([number]) + scaled_table(number, quality) for number in range(1 if grey else 2)]
    return b"".join(
        [_wrap(0xE0, jfif), *(_wrap(_DQT, table) for table in tables), _wrap(_SOF0, frame + b"".join(parts))]
    )


@cache
def scaled_table(number: int, quality: int) -> bytes:
    """Annex K's quantisation table (0 luma, 1 chroma) at libjpeg's quality 1..100, in zigzag order."""
    scale = 5000 // quality if quality < 50 else 200 - 2 * quality
    return bytes(
        min(max((step * scale + 50) // 100, 1), 255) for step in STANDARD_TABLES.quantisation[number]
    )


def read_header(header: bytes) -> JpegFrame:
    """The frame that a header of `JpegFile.header`'s kind declares. Raises NotBaselineError."""
    position, frames, steps = 0, [], dict[int, bytes]()
    while position < len(header):
        marker, body, position = _segment(header, position)
        if marker == _SOF0:
            frames.append(body)
        elif marker == _DQT:
            steps |= _quantisation(body)
        elif marker not in _KEPT:
            raise NotBaselineError(f"marker 0x{marker:02x} is no part of a header")
    if len(frames) != 1:
        raise NotBaselineError(f"{len(frames)} baseline frames: must be one")
    return _frame(frames[0], steps)


def header_for_decoding(header: bytes) -> JpegFrame:
    """`read_header` for bytes that a peer sent: raises DecodeError."""
    try:
        return read_header(header)
    except NotBaselineError as error:
        raise DecodeError(f"the JPEG header is unsound: {error}") from None


def _segment(data: bytes, position: int) -> tuple[int, bytes, int]:
    """Marker, body and end of the segment that starts at `position`."""
    if len(data) < position + 4 or data[position] != 0xFF:
        raise NotBaselineError(f"there is no marker segment at byte {position}")
    end = position + 2 + int.from_bytes(data[position + 2 : position + 4], "big")
    if end > len(data) or end < position + 4:
        raise NotBaselineError(f"the segment at byte {position} ends at {end} of {len(data)}")
    return data[position + 1], data[position + 4 : end], end


def _wrap(marker: int, body: bytes) -> bytes:
    return bytes([0xFF, marker]) + (len(body) + 2).to_bytes(2, "big") + body


def _quantisation(body: bytes) -> dict[int, bytes]:
    """The tables of a DQT segment's body, by their numbers."""
    starts = range(0, len(body), 65)
    if len(body) % 65 or any(body[at] > 3 or 0 in body[at + 1 : at + 65] for at in starts):
        raise NotBaselineError("a quantisation table is not one of 64 steps from 1 to 255")
    return {body[at]: body[at + 1 : at + 65] for at in starts}


def _frame(body: bytes, steps: dict[int, bytes]) -> JpegFrame:
    count = body[5] if len(body) > 5 else 0
    if count not in (1, 3) or len(body) != 6 + 3 * count or body[0] != 8:
        raise NotBaselineError("the frame is not one of 1 or 3 components of 8 bits")
    height, width = int.from_bytes(body[1:3], "big"), int.from_bytes(body[3:5], "big")
    parts = [body[6 + 3 * i : 9 + 3 * i] for i in range(count)]
    factors = [(part[1] >> 4, part[1] & 15) for part in parts]
    if not height or not width or any(not 1 <= side <= 4 for pair in factors for side in pair):
        raise NotBaselineError(f"a frame of {width}x{height} with sampling {factors} is not one to code")
    if len({part[0] for part in parts}) != count or any(part[2] not in steps for part in parts):
        raise NotBaselineError("two components have one identifier, or one has no quantisation table")
    if count == 1:
        factors = [(1, 1)]  # a scan of one component has no MCUs but its blocks, whatever it declares
    most_across, most_down = max(pair[0] for pair in factors), max(pair[1] for pair in factors)
    if sum(across * down for across, down in factors) > 10:
        raise NotBaselineError("an MCU holds more than 10 blocks")
    mcus_across, mcus_down = -(-width // (BLOCK * most_across)), -(-height // (BLOCK * most_down))
    components = tuple(
        Component(part[0], across, down, mcus_across * across, mcus_down * down, steps[part[2]])
        for part, (across, down) in zip(parts, factors, strict=True)
    )
    return JpegFrame(width, height, components, mcus_across * mcus_down, mcus_across)


def _with_scan(frame: JpegFrame, body: bytes) -> JpegFrame:
    """The frame with the Huffman tables that the scan's header names; it must hold all components."""
    count = len(frame.components)
    if len(body) != 4 + 2 * count or body[0] != count or body[-3:] != _ALL_COEFFICIENTS:
        raise NotBaselineError("the scan is not one of all components and all coefficients")
    components = []
    for number, part in enumerate(frame.components):
        identifier, selector = body[1 + 2 * number], body[2 + 2 * number]
        if identifier != part.identifier or selector not in (0x00, 0x11):
            raise NotBaselineError(f"component {identifier} has the Huffman tables 0x{selector:02x}")
        components.append(replace(part, huffman=selector & 15))
    return replace(frame, components=tuple(components))

"""JPEGs with fewer bytes and the very same pixels: what every decoder knows is not sent.

What comes back is a plain baseline JPEG that any viewer opens, with the same coefficients, quantisation
and metadata; it is the same file, byte for byte, where the Huffman tables were the standard ones and
there were no restart markers, as OpenCV and libjpeg write by default. What is not a sound baseline JPEG
(progressive, four components, other formats) travels as it is.
"""

from __future__ import annotations

from .codec_id import CodecId, codec_of, wished_codec
from .compiled import IS_COMPILED, Ints
from .errors import DecodeError, EncodeError
from .jpeg_context import decode_coefficients, encode_coefficients
from .jpeg_file import (
    JpegFile,
    JpegFrame,
    NotBaselineError,
    header_for_decoding,
    plain_header,
    read_jpeg,
    write_jpeg,
)
from .jpeg_scan import UnsoundScanError, count_symbols, layout_of, read_scan, write_scan
from .jpeg_tables import (
    LONGEST_CODE,
    STANDARD_TABLES,
    HuffmanTables,
    UnsoundTableError,
    check_table,
    fitted_table,
)

MAX_FILE_BYTES = 16_000_000
MAX_BLOCKS = 1 << 16  # of 8x8 samples: 64 MB of coefficients; 4:2:0 up to 2.8 megapixels
_CODECS = {"file": CodecId.IMAGE_FILE, "huffman": CodecId.IMAGE_JPEG, "context": CodecId.IMAGE_JPEG_CONTEXT}
_SAMPLINGS = (None, (1, 1), (2, 1), (2, 2), (1, 2))  # luma blocks across and down an MCU; None is grey
_GIVEN_HEADER = 7
_GIVEN_TABLES = 8
_HEADER_LENGTH_BYTES = 3


def pack_jpeg(jpeg: bytes, *, codec: CodecId | str | None = None) -> bytes:
    """The smallest message that `unpack_jpeg` turns into a JPEG of the same pixels.

    codec: "context" (small); "huffman" (the operator only puts the tables back); "file" (as it is); None
    for the smallest, without Numba the smallest of the latter two. A file that is no sound baseline JPEG,
    or too large for its codec, travels as it is.
    Raises EncodeError for an empty or too large file and for a codec of another product.
    """
    if not 0 < len(jpeg) <= MAX_FILE_BYTES:
        raise EncodeError(f"an image file of {len(jpeg)} bytes is outside 1..{MAX_FILE_BYTES}")
    codec = wished_codec(codec, _CODECS)
    unchanged = bytes([CodecId.IMAGE_FILE]) + jpeg
    if codec is CodecId.IMAGE_FILE:
        return unchanged
    try:
        file = read_jpeg(jpeg)
        if file.frame.blocks > MAX_BLOCKS:
            return unchanged
        coefficients = _coefficients(file)
    except (NotBaselineError, UnsoundTableError, UnsoundScanError):
        return unchanged
    messages = [unchanged]
    if codec is CodecId.IMAGE_JPEG_CONTEXT or (codec is None and IS_COMPILED):
        messages += _context_coded(file, coefficients)
    if len(messages) == 1:
        messages.append(_huffman_coded(file, coefficients))
    return min(messages, key=len)


def unpack_jpeg(data: bytes) -> bytes:
    """The image file of a message from `pack_jpeg` or `encode_image`. Raises DecodeError."""
    data = bytes(data)
    codec = codec_of(data)
    if len(data) > MAX_FILE_BYTES + 1:
        raise DecodeError(f"an image of {len(data)} bytes is above {MAX_FILE_BYTES + 1}")
    if codec is CodecId.IMAGE_FILE:
        return data[1:]
    if codec is CodecId.IMAGE_JPEG:
        return _from_huffman_coded(data)
    if codec is CodecId.IMAGE_JPEG_CONTEXT:
        return _from_context_coded(data)
    raise DecodeError(f"a view of codec {codec.name} is no image")


def _coefficients(file: JpegFile) -> Ints:
    """All quantised coefficients. Raises UnsoundScanError."""
    layout = layout_of(file.frame, [part.huffman for part in file.frame.components])
    return read_scan(file.scan, layout, file.tables, file.restart_mcus, file.frame.blocks)


def _context_coded(file: JpegFile, coefficients: Ints) -> list[bytes]:
    """The message, or none where it would take too long to read."""
    coded = encode_coefficients(coefficients, file.frame)
    return [bytes([CodecId.IMAGE_JPEG_CONTEXT]) + _packed_header(file) + coded] if coded is not None else []


def _from_context_coded(data: bytes) -> bytes:
    header, frame, position = _unpacked_header(data)
    coefficients = decode_coefficients(data[position:], frame)
    tables = STANDARD_TABLES.huffman
    return write_jpeg(
        header, frame, write_scan(coefficients, layout_of(frame, frame.standard_pairs), tables), tables
    )


def _huffman_coded(file: JpegFile, coefficients: Ints) -> bytes:
    """Under the standard tables, which are not sent, or under fitted ones, which are."""
    layout = layout_of(file.frame, file.frame.standard_pairs)
    scan = write_scan(coefficients, layout, STANDARD_TABLES.huffman)
    tables = _fitted_tables(coefficients, layout)
    sent = b"".join(body[1:] for body in tables.segments(file.frame.pairs))
    fitted = sent + write_scan(coefficients, layout, tables)
    flag, coded = (_GIVEN_TABLES, fitted) if len(fitted) < len(scan) else (0, scan)
    header = _packed_header(file)
    return bytes([CodecId.IMAGE_JPEG, header[0] | flag]) + header[1:] + coded


def _from_huffman_coded(data: bytes) -> bytes:
    header, frame, position = _unpacked_header(data)
    tables = STANDARD_TABLES.huffman
    if data[1] & _GIVEN_TABLES:
        tables, position = _unpacked_tables(data, position, frame.pairs)
    return write_jpeg(header, frame, data[position:], tables)


def _fitted_tables(coefficients: Ints, layout: Ints) -> HuffmanTables:
    dc_0, ac_0, dc_1, ac_1 = (fitted_table(counts) for counts in count_symbols(coefficients, layout))
    return HuffmanTables((dc_0, dc_1), (ac_0, ac_1))


def _packed_header(file: JpegFile) -> bytes:
    """A form byte, then quality, width and height of a plain header, or the header with its length."""
    frame = file.frame
    size = frame.width.to_bytes(2, "little") + frame.height.to_bytes(2, "little")
    first = frame.components[0]
    sampling = None if len(frame.components) == 1 else (first.across, first.down)
    if sampling in _SAMPLINGS:
        for quality in range(1, 101):
            if plain_header(frame.width, frame.height, sampling, quality) == file.header:
                return bytes([_SAMPLINGS.index(sampling), quality]) + size
    return bytes([_GIVEN_HEADER]) + len(file.header).to_bytes(_HEADER_LENGTH_BYTES, "little") + file.header


def _unpacked_header(data: bytes) -> tuple[bytes, JpegFrame, int]:
    """The JPEG header of a message, what it declares, and where the message goes on."""
    form = data[1] if len(data) > 1 else 0
    sampling, position = form & 7, 2 + _HEADER_LENGTH_BYTES
    if sampling == _GIVEN_HEADER:
        position += int.from_bytes(data[2:position], "little")
        header = data[2 + _HEADER_LENGTH_BYTES : position]
    else:
        position = 7
        quality, width = int.from_bytes(data[2:3], "little"), int.from_bytes(data[3:5], "little")
        height = int.from_bytes(data[5:7], "little")
        if sampling >= len(_SAMPLINGS) or not 1 <= quality <= 100:
            raise DecodeError(f"a JPEG of sampling {sampling} and quality {quality} is unknown")
        header = plain_header(width, height, _SAMPLINGS[sampling], quality)
    if position > len(data) or form > (_GIVEN_HEADER | _GIVEN_TABLES):
        raise DecodeError(f"the JPEG's header of form {form} ends at {position} of {len(data)} bytes")
    return header, header_for_decoding(header), position


def _unpacked_tables(data: bytes, position: int, pairs: int) -> tuple[HuffmanTables, int]:
    tables = []
    for _ in range(2 * pairs):
        end = position + LONGEST_CODE + sum(data[position : position + LONGEST_CODE])
        try:
            check_table(data[position:end])
        except UnsoundTableError as error:
            raise DecodeError(str(error)) from None
        tables.append(data[position:end])
        position = end
    tables += [b""] * (4 - len(tables))
    return HuffmanTables((tables[0], tables[2]), (tables[1], tables[3])), position

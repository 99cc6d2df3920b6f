"""Unsigned integers in as few bytes as they need: seven bits a byte, least significant first."""

from __future__ import annotations

from shaper.errors import DecodeError

MAX_BYTES = 6  # 42 bits: larger than any count, size or age in microseconds that a datagram carries
MAX_VALUE = (1 << 7 * MAX_BYTES) - 1


def append_varint(out: bytearray, value: int) -> None:
    """Append a value of 0 to MAX_VALUE."""
    assert 0 <= value <= MAX_VALUE, f"varint {value} is outside 0..{MAX_VALUE}"
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)


def read_varint(data: bytes, at: int) -> tuple[int, int]:
    """The value that starts at an offset, and the offset after it. Raises DecodeError."""
    value = shift = 0
    for position in range(at, min(at + MAX_BYTES, len(data))):
        byte = data[position]
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position + 1
        shift += 7
    raise DecodeError(f"a varint at byte {at} does not end")


def varint_bytes(value: int) -> int:
    """How many bytes a value takes."""
    return max(1, (value.bit_length() + 6) // 7)

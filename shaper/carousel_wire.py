"""The carousel's bytes: what one datagram holds, and what a message says of itself.

    datagram   0x06 · session 2 · number 5 · sealed [life 4 · message 4 · chunk 2 · chunks 2 · bytes] · tag 8
    message    flags 1 · capture stamp 4 · capture, Unix ns 8 · time to live in ms 4 · key and encoding, each
               as size 2 and UTF-8 · payload

Little-endian. Chunks of a message are all of one size but the last, so which of them a datagram holds says
where its bytes belong. The first eight bytes of a datagram are authenticated, the rest is encrypted too.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from shaper.errors import DecodeError

CAROUSEL = 0x06
CLEAR = struct.Struct("<BHIB")  # kind, session number, datagram number: low 32 bits, high 8 bits
NUMBER_BITS = 40
MOST_CHUNKS = 0xFFFF
MOST_MESSAGES = 1 << 32

_CHUNK = struct.Struct("<IIHH")
_HEAD = struct.Struct("<BIqI")
_SIZE = struct.Struct("<H")
_LATEST = 0x01
_LATEST_UNIX_NS = 1 << 62  # the year 2116

LIFE_BITS = 32
CHUNK_OVERHEAD_BYTES = _CHUNK.size


@dataclass(frozen=True, slots=True)
class Chunk:
    """A part of a message. life: of its sender, random; message: counts from 0 in each life."""

    life: int
    message: int
    index: int
    count: int
    data: bytes


@dataclass(frozen=True, slots=True)
class CarouselMessage:
    """A whole message. capture_us: low 32 bits of its sender's monotonic clock. ttl_ms: 0 for no limit."""

    key: str
    encoding: str
    payload: bytes
    capture_us: int
    capture_unix_ns: int
    ttl_ms: int
    latest: bool


def encode_clear(session_id: int, number: int) -> bytes:
    """What stands in the open at the head of a datagram."""
    return CLEAR.pack(CAROUSEL, session_id, number & 0xFFFF_FFFF, number >> 32)


def decode_clear(data: bytes) -> tuple[int, int]:
    """(session number, datagram number). Raises DecodeError."""
    if len(data) < CLEAR.size or data[0] != CAROUSEL:
        raise DecodeError(f"{len(data)} bytes are no datagram of a carousel")
    _, session_id, low, high = CLEAR.unpack_from(data)
    return session_id, high << 32 | low


def encode_chunk(chunk: Chunk) -> bytes:
    """A part of a message, before it is sealed."""
    return _CHUNK.pack(chunk.life, chunk.message, chunk.index, chunk.count) + chunk.data


def decode_chunk(body: bytes) -> Chunk:
    """Undo `encode_chunk`. Raises DecodeError."""
    if len(body) <= _CHUNK.size:
        raise DecodeError(f"a carousel's datagram of {len(body)} bytes has no part of a message")
    life, message, index, count = _CHUNK.unpack_from(body)
    if index >= count:
        raise DecodeError(f"chunk {index} of {count} cannot be")
    return Chunk(life, message, index, count, body[_CHUNK.size :])


def encode_message(message: CarouselMessage) -> bytes:
    """A message as its chunks carry it."""
    flags = _LATEST if message.latest else 0
    head = _HEAD.pack(flags, message.capture_us & 0xFFFF_FFFF, message.capture_unix_ns, message.ttl_ms)
    texts = (text.encode() for text in (message.key, message.encoding))
    return head + b"".join(_SIZE.pack(len(raw)) + raw for raw in texts) + message.payload


def decode_message(blob: bytes) -> CarouselMessage:
    """Undo `encode_message`. Raises DecodeError."""
    if len(blob) < _HEAD.size:
        raise DecodeError(f"a carousel's message of {len(blob)} bytes is shorter than its head")
    flags, capture_us, capture_unix_ns, ttl_ms = _HEAD.unpack_from(blob)
    if not 0 <= capture_unix_ns <= _LATEST_UNIX_NS:
        raise DecodeError(f"a capture time of {capture_unix_ns} ns is outside 0..{_LATEST_UNIX_NS}")
    key, at = _read_text(blob, _HEAD.size)
    encoding, at = _read_text(blob, at)
    return CarouselMessage(
        key, encoding, blob[at:], capture_us, capture_unix_ns, ttl_ms, bool(flags & _LATEST)
    )


def _read_text(blob: bytes, at: int) -> tuple[str, int]:
    begin = at + _SIZE.size
    end = begin + (_SIZE.unpack_from(blob, at)[0] if begin <= len(blob) else len(blob))
    if end > len(blob):
        raise DecodeError(f"a text at byte {at} runs past the end of a message of {len(blob)} bytes")
    try:
        return blob[begin:end].decode(), end
    except UnicodeDecodeError as error:
        raise DecodeError(f"a text at byte {at} is not UTF-8") from error

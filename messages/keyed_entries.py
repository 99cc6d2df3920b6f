"""A protobuf message as a table: the items of one repeated field, told apart by a hash of their key.

Works on the wire format alone (protobuf's encoding guide: tag = field number << 3 | wire type), so any
schema will do: concatenating raw pieces of a message gives a message again.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from hashlib import blake2s
from typing import NamedTuple

REST = 0  # the hash under which everything outside the items stands

_VARINT, _FIXED64, _LENGTH, _FIXED32 = 0, 1, 2, 5


class NotProtobufError(ValueError):
    """The bytes are no protobuf message."""


class Entry(NamedTuple):
    """An item. raw: its bytes with tag and length. compared: the same without the fields to ignore."""

    raw: bytes
    compared: bytes


def split_entries(
    message: bytes,
    field: int,
    key_field: int,
    ignored: Collection[int] = (),
    ignored_outside: Collection[int] = (),
) -> dict[int, Entry]:
    """Items of the repeated message field by the 32-bit hash of their key, and REST.

    Items with one hash (the same key twice, or a collision: 1 in 10^6 for 100 names) stay together.
    Raises NotProtobufError.
    """
    entries = {REST: Entry(b"", b"")}
    for number, wire_type, raw, value in _fields(message):
        if number == field and wire_type == _LENGTH:
            parts = list(_fields(value))
            key = next((v for n, _, _, v in parts if n == key_field), b"")
            compared = b"".join(r for n, _, r, _ in parts if n not in ignored)
            name = key_hash(key)
        else:
            name, compared = REST, b"" if number in ignored_outside else raw
        before = entries.get(name, Entry(b"", b""))
        entries[name] = Entry(before.raw + raw, before.compared + compared)
    return entries


def key_hash(key: bytes) -> int:
    """32 bits of a key, never REST."""
    return int.from_bytes(blake2s(key, digest_size=4).digest(), "little") or 1


def _fields(message: bytes) -> Iterator[tuple[int, int, bytes, bytes]]:
    """(field number, wire type, raw bytes with the tag, value bytes) of each field in turn."""
    at = 0
    while at < len(message):
        start = at
        tag, at = _varint(message, at)
        number, wire_type = tag >> 3, tag & 7
        value_at = at
        if wire_type == _VARINT:
            _, at = _varint(message, at)
        elif wire_type == _LENGTH:
            size, value_at = _varint(message, at)
            at = value_at + size
        elif wire_type in (_FIXED64, _FIXED32):
            at += 8 if wire_type == _FIXED64 else 4
        else:
            raise NotProtobufError(f"wire type {wire_type} at byte {start} is none that is in use")
        if number == 0 or at > len(message):
            raise NotProtobufError(f"the field at byte {start} runs past the end, or has number 0")
        yield number, wire_type, message[start:at], message[value_at:at]


def _varint(message: bytes, at: int) -> tuple[int, int]:
    value = shift = 0
    for position in range(at, min(at + 10, len(message))):
        byte = message[position]
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position + 1
        shift += 7
    raise NotProtobufError(f"the varint at byte {at} does not end")

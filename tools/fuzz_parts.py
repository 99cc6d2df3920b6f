"""One fuzzed input as several parts, each with its length in front: datagrams or messages in a row."""

from __future__ import annotations

from collections.abc import Iterable

_MAX_PART_BYTES = 1500


def join_parts(parts: Iterable[bytes]) -> bytes:
    """What `split_parts` takes apart."""
    return b"".join(len(part).to_bytes(2, "little") + part for part in parts)


def split_parts(data: bytes) -> Iterable[bytes]:
    """Total on any bytes; the last part may be shorter than it says."""
    at = 0
    while at + 2 <= len(data):
        size = int.from_bytes(data[at : at + 2], "little") % _MAX_PART_BYTES
        yield data[at + 2 : at + 2 + size]
        at += 2 + size

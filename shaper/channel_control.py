"""What the two channels say to each other: probes of the path's MTU, topic tables,
and whether the peer is where it seems to be.

nothing   (empty)                        proves that the sender has the keys
probe     0x01 · padding                 to be answered with its size
passed    0x02 · size 2                  a probe of this UDP payload has come
ask, part 0x03, 0x04                     (shaper.table_exchange)
challenge 0x05 · token 8                 is the peer where this goes?
answered  0x06 · token 8                 it is
"""

from __future__ import annotations

from shaper.errors import DecodeError
from shaper.session import CLEAR_BYTES, TAG_BYTES
from shaper.whereabouts import TOKEN_BYTES

PROBE, PASSED = 0x01, 0x02
CHALLENGE, ANSWERED = b"\x05", b"\x06"
CONTROL_OVERHEAD_BYTES = CLEAR_BYTES + TAG_BYTES
CHALLENGE_BYTES = 1 + TOKEN_BYTES


def encode_probe(datagram_bytes: int) -> bytes:
    """A payload that makes a control datagram of this size (UDP payload)."""
    return bytes([PROBE]).ljust(datagram_bytes - CONTROL_OVERHEAD_BYTES, b"\0")


def encode_passed(datagram_bytes: int) -> bytes:
    """The answer to a probe."""
    return bytes([PASSED]) + datagram_bytes.to_bytes(2, "little")


def decode_passed(payload: bytes) -> int:
    """The size that an answer names. Raises DecodeError."""
    if len(payload) != 3:
        raise DecodeError(f"an answer to a probe has {len(payload)} bytes: expected 3")
    return int.from_bytes(payload[1:], "little")

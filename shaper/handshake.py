"""The two datagrams by which the ends of a link recognise each other, and what they tell in them.

    initiation  0x03 · key identifier 4 · Noise message with a hello · check 8: 89 bytes
    answer      0x04 · the initiator's session number 2 · Noise message with a hello: 79 bytes

Each names the side that started in its prologue, so that a reflected initiation is no initiation. The
check costs two microseconds: whoever does not hold the key cannot make us do more than that.
"""

from __future__ import annotations

import hmac
import struct
from dataclasses import dataclass
from typing import Literal

from shaper.errors import DecodeError
from shaper.link_key import ID_BYTES, LinkKey
from shaper.noise import OVERHEAD_BYTES

Side = Literal["robot", "operator"]

INITIATION, ANSWER = 0x03, 0x04
SESSION_ID_BYTES = 2
MEMORY_BYTES = 8
TABLE_HASH_BYTES = 8

_HELLO = struct.Struct(f"<HHq{MEMORY_BYTES}s{TABLE_HASH_BYTES}s")
_CHECK_BYTES = 8
INITIATION_BYTES = 1 + ID_BYTES + OVERHEAD_BYTES + _HELLO.size + _CHECK_BYTES
ANSWER_BYTES = 1 + SESSION_ID_BYTES + OVERHEAD_BYTES + _HELLO.size


@dataclass(frozen=True, slots=True)
class Identity:
    """What a side is for as long as it runs.

    epoch: new at each start. memory: what it remembers of reliable messages; the same after a restart if
    it keeps a journal. table_hash: of its topics and schemas.
    """

    epoch: int
    memory: bytes
    table_hash: bytes


@dataclass(frozen=True, slots=True)
class Hello:
    """What a handshake tells of its sender. session_id: by which it wants to be addressed."""

    session_id: int
    unix_ns: int
    identity: Identity


def prologue(initiator: Side) -> bytes:
    """What both sides must agree on before they start."""
    return b"straitlink link 1, from the " + initiator.encode()


def other_side(side: Side) -> Side:
    """Who is at the other end."""
    return "operator" if side == "robot" else "robot"


def check_key(key: LinkKey) -> bytes:
    """What initiations under a link key are checked with: not the key itself, as that is Noise's."""
    return hmac.digest(key.secret, b"straitlink link 1, check of an initiation", "sha256")


def encode_initiation(key: LinkKey, check: bytes, message: bytes) -> bytes:
    """The datagram around a Noise message. check: of `check_key`."""
    body = bytes([INITIATION]) + key.id + message
    return body + hmac.digest(check, body, "sha256")[:_CHECK_BYTES]


def decode_initiation(data: bytes, check: bytes) -> bytes:
    """The Noise message in a datagram. Raises DecodeError unless a holder of the key has made it."""
    body = data[:-_CHECK_BYTES]
    if not hmac.compare_digest(hmac.digest(check, body, "sha256")[:_CHECK_BYTES], data[-_CHECK_BYTES:]):
        raise DecodeError("an initiation is not from a holder of the link key")
    return body[1 + ID_BYTES :]


def encode_hello(hello: Hello) -> bytes:
    """A hello as the payload of a handshake message."""
    identity = hello.identity
    return _HELLO.pack(hello.session_id, identity.epoch, hello.unix_ns, identity.memory, identity.table_hash)


def decode_hello(payload: bytes) -> Hello:
    """Undo `encode_hello`. Raises DecodeError."""
    if len(payload) != _HELLO.size:
        raise DecodeError(f"a hello of {len(payload)} bytes: expected {_HELLO.size}")
    session_id, epoch, unix_ns, memory, table_hash = _HELLO.unpack(payload)
    return Hello(session_id, unix_ns, Identity(epoch, memory, table_hash))

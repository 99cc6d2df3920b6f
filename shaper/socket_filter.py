"""A filter in front of the link's socket: what cannot be the peer's costs the kernel a few instructions.

A stranger can send faster than a Python program reads. A classic BPF program (Linux, SO_ATTACH_FILTER;
no privilege needed) lets through what has the session number of the moment or the exact size of a
handshake; the channel decides about the rest. Offsets count from the UDP header.
Source: Documentation/networking/filter.rst of the Linux kernel.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable

from shaper.handshake import ANSWER, ANSWER_BYTES, INITIATION, INITIATION_BYTES
from shaper.session import CONTROL, PROTECTED

SO_ATTACH_FILTER = 26  # asm-generic/socket.h
MAX_IDS = 40  # jumps reach 255 instructions
_UDP_BYTES = 8
_KIND_AT = _UDP_BYTES
_SESSION_AT = _UDP_BYTES + 1

_LOAD_BYTE, _LOAD_HALF, _LOAD_WORD, _LOAD_LENGTH = 0x30, 0x28, 0x20, 0x80
_RANDOM = 0xFFFF_F000 + 56  # SKF_AD_OFF + SKF_AD_RANDOM: a random word
_AND, _JUMP_EQUAL, _RETURN = 0x54, 0x15, 0x06
_TAKE, _DROP = 0xFFFF_FFFF, 0
_INSTRUCTION = struct.Struct("=HBBI")

Instruction = tuple[int, int, int, int]  # code, jump if true, jump if false, constant


def filter_program(
    session_ids: Iterable[int], key_ids: Iterable[bytes] = (), one_in: int = 1
) -> list[Instruction]:
    """What takes datagrams of these sessions, and handshakes.

    key_ids: initiations that name another key are dropped; none while no session is there yet, so that
    the channel can tell of a key that is not ours. one_in: a power of two; of initiations only one in so
    many passes, by chance.
    """
    sessions = [int.from_bytes(i.to_bytes(2, "little"), "big") for i in session_ids][:MAX_IDS]
    keys = [int.from_bytes(i, "big") for i in key_ids]
    by_session = [(_LOAD_HALF, 0, 0, _SESSION_AT), *_any_of(sessions)]
    by_key = [(_LOAD_WORD, 0, 0, _SESSION_AT), *_any_of(keys)] if keys else [_end(_TAKE)]
    initiation = [*_if_length(INITIATION_BYTES), *_by_chance(one_in), *by_key]
    answer = [*_if_length(ANSWER_BYTES), *by_session]
    program: list[Instruction] = [(_LOAD_BYTE, 0, 0, _KIND_AT), (_AND, 0, 0, 0x0F)]
    for kind, block in (
        (PROTECTED, by_session),
        (CONTROL, by_session),
        (INITIATION, initiation),
        (ANSWER, answer),
    ):
        program += [(_JUMP_EQUAL, 0, len(block), kind), *block]
    return [*program, _end(_DROP)]


def encode_program(program: Iterable[Instruction]) -> bytes:
    """As the kernel takes it."""
    return b"".join(_INSTRUCTION.pack(*instruction) for instruction in program)


def _any_of(values: list[int]) -> list[Instruction]:
    """Take if the accumulator is one of them, else drop."""
    tests = [(_JUMP_EQUAL, len(values) - index, 0, value) for index, value in enumerate(values)]
    return [*tests, _end(_DROP), _end(_TAKE)]


def _if_length(payload_bytes: int) -> list[Instruction]:
    return [
        (_LOAD_LENGTH, 0, 0, 0),
        (_JUMP_EQUAL, 1, 0, _UDP_BYTES + payload_bytes),
        _end(_DROP),
    ]


def _by_chance(one_in: int) -> list[Instruction]:
    """Go on with one in so many, drop the others."""
    if one_in == 1:
        return []
    return [(_LOAD_WORD, 0, 0, _RANDOM), (_AND, 0, 0, one_in - 1), (_JUMP_EQUAL, 1, 0, 0), _end(_DROP)]


def _end(verdict: int) -> Instruction:
    return _RETURN, 0, 0, verdict

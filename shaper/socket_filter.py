"""A filter in front of the link's socket: what cannot be the peer's costs the kernel a few instructions.

A stranger can send faster than a Python program reads. A classic BPF program (Linux, SO_ATTACH_FILTER;
no privilege needed) lets through what has the session number of the moment or the exact size of a
handshake; the channel decides about the rest. Offsets count from the UDP header.
Source: Documentation/networking/filter.rst of the Linux kernel.
"""

from __future__ import annotations

import ipaddress
import struct
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from shaper.flood_gate import Openings
from shaper.handshake import ANSWER, ANSWER_BYTES, INITIATION, INITIATION_BYTES
from shaper.session import CONTROL, PROTECTED
from shaper.whereabouts import Address

SO_ATTACH_FILTER = 26  # asm-generic/socket.h
MAX_IDS = 40  # jumps reach 255 instructions
_MAX_KEYS = 20  # with more, all initiations reach the channel
_UDP_BYTES = 8
_KIND_AT = _UDP_BYTES
_SESSION_AT = _UDP_BYTES + 1

_LOAD_BYTE, _LOAD_HALF, _LOAD_WORD, _LOAD_LENGTH = 0x30, 0x28, 0x20, 0x80
_RANDOM = 0xFFFF_F000 + 56  # SKF_AD_OFF + SKF_AD_RANDOM: a random word
_IP_HEADER = 0xFFF0_0000  # SKF_NET_OFF: offsets from the IP header
_SOURCE_AT = {4: 12, 6: 8}  # the source's address in it, by version; its port is the UDP header's first half
_AND, _JUMP_EQUAL, _RETURN = 0x54, 0x15, 0x06
_TAKE, _DROP = 0xFFFF_FFFF, 0
_INSTRUCTION = struct.Struct("=HBBI")

Instruction = tuple[int, int, int, int]  # code, jump if true, jump if false, constant


_ALL_OPEN = Openings()


class Admission(NamedTuple):
    """What may reach the program: datagrams of these sessions, and handshakes.

    key_ids: initiations that name another key are dropped; none while no session is there yet, so that
    the channel can tell of a key that is not ours. peers: where the peer is or should be. openings: of
    what comes from there or from elsewhere only one in so many passes, by chance; powers of two.
    """

    session_ids: tuple[int, ...] = ()
    key_ids: tuple[bytes, ...] = ()
    peers: tuple[Address, ...] = ()
    openings: Openings = _ALL_OPEN


def filter_program(admission: Admission) -> list[Instruction]:
    """What takes what is admitted, and drops the rest."""
    sessions = [int.from_bytes(i.to_bytes(2, "little"), "big") for i in admission.session_ids][:MAX_IDS]
    keys = [int.from_bytes(i, "big") for i in admission.key_ids]
    by_session = [(_LOAD_HALF, 0, 0, _SESSION_AT), *_any_of(sessions)]
    by_key = (
        [(_LOAD_WORD, 0, 0, _SESSION_AT), *_any_of(keys)] if 0 < len(keys) <= _MAX_KEYS else [_end(_TAKE)]
    )
    openings, peers = admission.openings, admission.peers
    anybodys = [*_by_chance(openings.initiations), *by_key]
    by_source = _by_source(peers, anybodys, [*_by_chance(openings.of_peer), *by_key])
    initiation = [*_if_length(INITIATION_BYTES), *by_source]
    sealed = _by_source(peers, [*_by_chance(openings.sealed), *by_session], by_session)
    answer = [*_if_length(ANSWER_BYTES), *by_session]
    program: list[Instruction] = [(_LOAD_BYTE, 0, 0, _KIND_AT), (_AND, 0, 0, 0x0F)]
    for kind, block in (
        (PROTECTED, sealed),
        (CONTROL, sealed),
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


def _by_source(
    sources: Sequence[Address], otherwise: list[Instruction], theirs: list[Instruction]
) -> list[Instruction]:
    """One way to judge what comes from these addresses, another one for all else."""
    if otherwise == theirs:
        return theirs
    program = otherwise
    for host, port in reversed(sources):
        address = ipaddress.ip_address(host.partition("%")[0])
        at, packed = _IP_HEADER + _SOURCE_AT[address.version], address.packed
        words = [(at + i, int.from_bytes(packed[i : i + 4], "big")) for i in range(0, len(packed), 4)]
        test: list[Instruction] = [(_LOAD_HALF, 0, 0, 0), (_JUMP_EQUAL, len(program), 0, port)]
        for offset, word in reversed(words):
            test = [(_LOAD_WORD, 0, 0, offset), (_JUMP_EQUAL, 0, len(test), word), *test]
        program = [*test, *program]
    return [*program, *theirs]


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

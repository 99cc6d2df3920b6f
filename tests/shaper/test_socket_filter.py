"""What cannot be the peer's never reaches the program: the filter's program, run here and by the kernel."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import socket
import struct
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shaper.flood_gate import FloodGate
from shaper.handshake import ANSWER_BYTES, INITIATION_BYTES
from shaper.socket_filter import SO_ATTACH_FILTER, Instruction, encode_program, filter_program
from shaper.udp import UdpLink
from tests.shaper.pair import S
from tests.shaper.secured import KEY, SecuredPair
from tests.shaper.test_udp import free_address, run

OURS, OTHER = 0x1234, 0x3412


def takes(program: list[Instruction], payload: bytes, chance: int = 0) -> bool:
    """The kernel's interpreter, as far as the program needs it; a load past the end drops."""
    data, at, accumulator = bytes(8) + payload, 0, 0
    while True:
        code, if_true, if_false, k = program[at]
        at += 1
        if code in (0x30, 0x28, 0x20):
            if k == 0xFFFF_F038:
                accumulator = chance
                continue
            size = {0x30: 1, 0x28: 2, 0x20: 4}[code]
            if k + size > len(data):
                return False
            accumulator = int.from_bytes(data[k : k + size], "big")
        elif code == 0x80:
            accumulator = len(data)
        elif code == 0x54:
            accumulator &= k
        elif code == 0x15:
            at += if_true if accumulator == k else if_false
        else:
            assert code == 0x06
            return k != 0


def sealed(kind: int, session: int) -> bytes:
    return bytes([kind]) + session.to_bytes(2, "little") + bytes(30)


@pytest.mark.parametrize(
    ("payload", "taken"),
    [
        (sealed(0x02, OURS), True),
        (sealed(0x12, OURS), True),  # with the flags of a plain datagram
        (sealed(0x05, OURS), True),
        (sealed(0x02, OTHER), False),
        (sealed(0x01, OURS), False),
        (bytes([3]) + KEY.id + bytes(INITIATION_BYTES - 5), True),
        (bytes([3]) + b"none" + bytes(INITIATION_BYTES - 5), False),
        (bytes([3]) + KEY.id + bytes(INITIATION_BYTES - 6), False),
        (sealed(0x04, OURS)[:3] + bytes(ANSWER_BYTES - 3), True),
        (sealed(0x04, OTHER)[:3] + bytes(ANSWER_BYTES - 3), False),
        (b"", False),
        (b"\x02", False),
    ],
)
def test_the_filter_takes_sessions_and_handshakes_only(payload: bytes, taken: bool) -> None:
    assert takes(filter_program([7, OURS], [KEY.id]), payload) is taken


@given(st.binary(max_size=100), st.lists(st.integers(0, 0xFFFF), max_size=60))
def test_the_filter_ends_on_any_datagram(data: bytes, ids: list[int]) -> None:
    takes(filter_program(ids, [KEY.id]), data)


def test_without_a_session_a_foreign_key_can_be_told() -> None:
    assert takes(filter_program([]), bytes([3]) + b"none" + bytes(INITIATION_BYTES - 5))


def test_whatever_the_peer_sends_passes_the_filter() -> None:
    pair = SecuredPair()
    for _ in range(40):
        pair.advance(S // 10)
        pair.offer(pair.robot, "robot/command/a", b"x")
        for host in pair.hosts:
            program = filter_program(pair.other(host).channel.session_ids())
            underway = [data for _, data, source, _ in pair.underway if source == host.address]
            assert all(takes(program, data) for data in underway)


@pytest.mark.skipif(sys.platform != "linux", reason="SO_ATTACH_FILTER is Linux's")
def test_the_kernel_drops_what_the_filter_drops() -> None:
    async def story() -> None:
        inbox: asyncio.Queue[bytes] = asyncio.Queue()
        here = free_address()
        link = await UdpLink.open(here, free_address(), lambda ds: [inbox.put_nowait(d) for d, _, _ in ds])
        assert link.take_only([OURS], [KEY.id])
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            for payload in (b"noise", sealed(2, OTHER), sealed(2, OURS), bytes(INITIATION_BYTES)):
                stranger.sendto(payload, here)
            assert await inbox.get() == sealed(2, OURS)
            assert link.take_only([OTHER], [])
            stranger.sendto(sealed(2, OURS), here)
            stranger.sendto(sealed(2, OTHER), here)
            assert await inbox.get() == sealed(2, OTHER)
        link.close()

    run(story)


def test_in_a_flood_one_initiation_in_many_passes_and_all_of_the_session() -> None:
    program = filter_program([OURS], [KEY.id], one_in=64)
    initiation = bytes([3]) + KEY.id + bytes(INITIATION_BYTES - 5)
    assert sum(takes(program, initiation, chance) for chance in range(640)) == 10
    assert all(takes(program, sealed(0x02, OURS), chance) for chance in range(64))
    assert takes(program, sealed(0x04, OURS)[:3] + bytes(ANSWER_BYTES - 3), 1)


def test_the_gate_closes_in_a_flood_and_opens_after_it() -> None:
    gate, unwanted, closing = FloodGate(0), 0, []
    for tick in range(1, 41):  # 100,000 a second for five seconds, then none
        unwanted += 25_000 // gate.one_in if tick <= 20 else 0
        closing.append(gate.look(unwanted, tick * S // 4))
    assert closing[7] == closing[19] == 256, "some 400 a second pass"
    assert closing[-1] == 1


@pytest.mark.skipif(sys.platform != "linux", reason="a filter of Linux")
def test_the_kernel_lets_one_in_many_through() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.setblocking(False)
        program = encode_program(filter_program([OURS], [KEY.id], one_in=8))
        buffer = ctypes.create_string_buffer(program)
        head = struct.pack("HP", len(program) // 8, ctypes.addressof(buffer))
        receiver.setsockopt(socket.SOL_SOCKET, SO_ATTACH_FILTER, head)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            for _ in range(400):
                stranger.sendto(bytes([3]) + KEY.id + bytes(INITIATION_BYTES - 5), receiver.getsockname())
        came = 0
        with contextlib.suppress(BlockingIOError):
            while receiver.recv(2000):
                came += 1
        assert 10 <= came <= 110, "50 of 400 by chance; beyond six standard deviations it is none"

"""What cannot be the peer's never reaches the program: the filter's program, run here and by the kernel."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import ipaddress
import random
import socket
import struct
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shaper.flood_gate import FloodGate, FloodGates, Openings
from shaper.handshake import ANSWER_BYTES, INITIATION_BYTES
from shaper.socket_filter import SO_ATTACH_FILTER, Admission, Instruction, encode_program, filter_program
from shaper.udp import UdpLink
from tests.shaper.pair import S
from tests.shaper.secured import ADDRESSES, KEY, SecuredPair
from tests.shaper.test_udp import free_address, run

OURS, OTHER = 0x1234, 0x3412


ANYBODY, PEER = ("203.0.113.9", 4242), ("10.0.0.2", 9002)
INITIATION = bytes([3]) + KEY.id + bytes(INITIATION_BYTES - 5)


def takes(
    program: list[Instruction], payload: bytes, chance: int = 0, source: tuple[str, int] = ANYBODY
) -> bool:
    """The kernel's interpreter, as far as the program needs it; a load past the end drops."""
    data, at, accumulator = source[1].to_bytes(2, "big") + bytes(6) + payload, 0, 0
    packed = ipaddress.ip_address(source[0]).packed
    ip_header = bytes(12 if len(packed) == 4 else 8) + packed + bytes(16)
    while True:
        code, if_true, if_false, k = program[at]
        at += 1
        if code in (0x30, 0x28, 0x20):
            if k == 0xFFFF_F038:
                accumulator = chance
                continue
            if k >= 0xFFF0_0000:
                k -= 0xFFF0_0000
                accumulator = int.from_bytes(ip_header[k : k + 4], "big")
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
    assert takes(filter_program(Admission((7, OURS), (KEY.id,))), payload) is taken


@given(st.binary(max_size=100), st.lists(st.integers(0, 0xFFFF), max_size=60))
def test_the_filter_ends_on_any_datagram(data: bytes, ids: list[int]) -> None:
    takes(filter_program(Admission(tuple(ids), (KEY.id,), (PEER, ANYBODY), Openings(8, 64, 16))), data)


def test_without_a_session_a_foreign_key_can_be_told() -> None:
    assert takes(filter_program(Admission()), bytes([3]) + b"none" + bytes(INITIATION_BYTES - 5))


def test_whatever_the_peer_sends_passes_the_filter() -> None:
    pair = SecuredPair()
    for _ in range(40):
        pair.advance(S // 10)
        pair.offer(pair.robot, "robot/command/a", b"x")
        for host in pair.hosts:
            program = filter_program(Admission(tuple(pair.other(host).channel.session_ids())))
            underway = [data for _, data, source, _ in pair.underway if source == host.address]
            assert all(takes(program, data) for data in underway)


@pytest.mark.skipif(sys.platform != "linux", reason="SO_ATTACH_FILTER is Linux's")
def test_the_kernel_drops_what_the_filter_drops() -> None:
    async def story() -> None:
        inbox: asyncio.Queue[bytes] = asyncio.Queue()
        here = free_address()
        link = await UdpLink.open(here, free_address(), lambda ds: [inbox.put_nowait(d) for d, _, _ in ds])
        assert link.take_only(Admission((OURS,), (KEY.id,)))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            for payload in (b"noise", sealed(2, OTHER), sealed(2, OURS), bytes(INITIATION_BYTES)):
                stranger.sendto(payload, here)
            assert await inbox.get() == sealed(2, OURS)
            assert link.take_only(Admission((OTHER,)))
            stranger.sendto(sealed(2, OURS), here)
            stranger.sendto(sealed(2, OTHER), here)
            assert await inbox.get() == sealed(2, OTHER)
        link.close()

    run(story)


def test_in_a_flood_one_initiation_in_many_passes_and_all_of_the_session() -> None:
    program = filter_program(Admission((OURS,), (KEY.id,), openings=Openings(initiations=64)))
    initiation = bytes([3]) + KEY.id + bytes(INITIATION_BYTES - 5)
    assert sum(takes(program, initiation, chance) for chance in range(640)) == 10
    assert all(takes(program, sealed(0x02, OURS), chance) for chance in range(64))
    assert takes(program, sealed(0x04, OURS)[:3] + bytes(ANSWER_BYTES - 3), 1)


@pytest.mark.parametrize("peer", [PEER, ("2001:db8::7", 9002)])
def test_a_strangers_flood_does_not_close_the_gate_for_the_peers_address(peer: tuple[str, int]) -> None:
    program = filter_program(Admission((OURS,), (KEY.id,), (ADDRESSES["operator"], peer), Openings(1, 4096)))
    assert all(takes(program, INITIATION, chance, peer) for chance in range(64))
    assert not takes(program, INITIATION, 1, ANYBODY)
    assert not takes(program, INITIATION, 1, (peer[0], peer[1] + 1))
    assert not takes(program, INITIATION, 1, ("2001:db8::8", peer[1]))
    assert not takes(program, bytes([3]) + b"none" + INITIATION[5:], 0, peer)
    spoofed = filter_program(Admission((OURS,), (KEY.id,), (peer,), Openings(64, 1)))
    assert sum(takes(spoofed, INITIATION, chance, peer) for chance in range(640)) == 10


def test_the_gate_closes_at_the_first_batches_of_a_flood_and_opens_after_it() -> None:
    gate, passed, now_ns = FloodGate(0), 0.0, S
    gate.look(0, now_ns)
    while now_ns < 3 * S:  # 100,000 a second, looked at every millisecond
        now_ns += S // 1000
        passed += 100 / gate.one_in
        gate.look(int(passed), now_ns)
    assert passed < 500, "a hundred a second, and two batches"
    for _ in range(20):
        now_ns += S // 4
        gate.look(int(passed), now_ns)
    assert gate.one_in == 1


def test_a_peer_that_starts_anew_in_a_flood_is_answered_at_once() -> None:
    pair = SecuredPair()
    pair.advance(S)
    noise = random.Random(3)
    for _ in range(300):
        forged = INITIATION[:5] + noise.randbytes(INITIATION_BYTES - 5)
        pair.receive(pair.operator, forged, ANYBODY)
    operator = pair.operator.channel
    assert (operator.unwanted.of_peer, operator.unwanted.initiations) == (0, 300)
    openings = FloodGates(0).look(operator.unwanted, S // 1000)
    assert openings.initiations > 64
    admission = Admission(tuple(operator.session_ids()), (KEY.id,), operator.peers, openings)
    pair.start(pair.robot)
    pair.pump(pair.robot)
    _, first_word, _ = pair.robot.sent[-1]
    assert takes(filter_program(admission), first_word, 1, pair.robot.address)


def test_a_flood_of_forged_sealed_datagrams_leaves_the_peers_alone() -> None:
    pair = SecuredPair()
    pair.advance(S)
    operator = pair.operator.channel
    forged = bytes([2]) + operator._current.own_id.to_bytes(2, "little") + bytes(60)
    for _ in range(300):
        pair.receive(pair.operator, forged, ANYBODY)
    assert operator.unwanted.sealed == 300
    openings = FloodGates(0).look(operator.unwanted, S // 1000)
    program = filter_program(Admission(tuple(operator.session_ids()), (KEY.id,), operator.peers, openings))
    assert not takes(program, forged, 1, ANYBODY) and takes(program, forged, 0, ANYBODY)
    assert takes(program, forged, 1, pair.robot.address)
    pair.receive(pair.operator, forged, pair.robot.address)
    assert operator.unwanted.sealed == 300, "whoever forges the peer's address can cut the link anyway"


@pytest.mark.skipif(sys.platform != "linux", reason="a filter of Linux")
def test_the_kernel_lets_one_in_many_through() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.setblocking(False)
        program = encode_program(
            filter_program(Admission((OURS,), (KEY.id,), openings=Openings(initiations=8)))
        )
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

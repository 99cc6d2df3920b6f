"""A shaper's first word, on loopback: it leaves before anybody is there to take what the peer says."""

from __future__ import annotations

import asyncio
import os
import socket
import time
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

from shaper.config import load_config
from shaper.doorstep import Doorstep
from shaper.handshake import Identity
from shaper.key_file import read_key_file, write_key_file
from shaper.link_key import make_link_key
from shaper.secure_channel import SecureChannel
from shaper.udp import UdpError
from tests.shaper.test_udp import free_address

CONFIG = """
[link]
side = "robot"
listen = "127.0.0.1:{listen}"
peer = "127.0.0.1:{peer}"
keys = ["link.key"]
journal = "robot.journal"
[zenoh]
[[topics]]
key = "robot/**"
class = "state"
"""


class Peer:
    """The operator's channel behind a plain socket."""

    def __init__(self, folder: Path) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(3)
        self.address: tuple[str, int] = self.socket.getsockname()
        self.robot = free_address()
        write_key_file(folder / "link.key", make_link_key(os.urandom))
        text = CONFIG.format(listen=self.robot[1], peer=self.address[1])
        (folder / "robot.toml").write_text(text)
        self.config = load_config(folder / "robot.toml")
        key = read_key_file(folder / "link.key")
        identity = Identity(1, bytes(8), bytes(8))
        self.channel = SecureChannel("operator", [key], identity, self.robot, os.urandom, 0, time.time_ns())
        self.channel.next_handshake(0)  # its own first word was lost

    def hear(self) -> bytes:
        data, source = self.socket.recvfrom(2048)
        self.channel.receive(data, source, 1)
        return data

    def answer(self) -> bytes:
        answer = self.channel.next_handshake(2)
        assert answer is not None
        self.socket.sendto(*answer)
        return answer[0]


@pytest.fixture
def peer(tmp_path: Path) -> Any:
    made = Peer(tmp_path)
    yield made
    made.socket.close()


def run(story: Callable[[], Coroutine[Any, Any, None]]) -> None:
    asyncio.run(asyncio.wait_for(story(), 5))


async def until(condition: Callable[[], bool]) -> None:
    while not condition():
        await asyncio.sleep(0)


def test_the_answer_to_the_first_word_waits_for_whoever_takes_it(peer: Peer) -> None:
    async def story() -> None:
        with Doorstep(peer.config) as door:
            await door.step()
            assert len(peer.hear()) == door.said_bytes
            peer.socket.sendto(b"\x02" + bytes(60), peer.robot)  # nobody could be told of that yet
            answer = peer.answer()
            await until(lambda: bool(door._answers))
            assert not door.channel.ready, "the other side would take it for up"
            taken: list[bytes] = []
            door.hand_over(lambda datagrams: taken.extend(data for data, _, _ in datagrams))
            assert taken == [answer]
            door.channel.receive(answer, peer.address, time.monotonic_ns())
            assert door.channel.ready
            assert not peer.channel.ready, "it has not proven itself yet"
            proof = door.channel.next_handshake(time.monotonic_ns())
            assert proof is not None
            peer.channel.receive(proof[0], peer.robot, 3)
            assert peer.channel.ready

    run(story)


def test_an_answer_that_has_waited_for_long_is_asked_for_again(peer: Peer) -> None:
    async def story() -> None:
        with Doorstep(peer.config) as door:
            await door.step()
            peer.hear()
            long_ago_ns = time.monotonic_ns() - 11_000_000_000
            door._keep_answers([(b"\x04" + bytes(78), peer.address, long_ago_ns)])
            taken: list[object] = []
            door.hand_over(taken.append)
            assert taken == []

    run(story)


def test_a_flood_of_false_answers_takes_no_memory(peer: Peer) -> None:
    async def story() -> None:
        with Doorstep(peer.config) as door:
            await door.step()
            for _ in range(1000):
                door._keep_answers([(b"\x04" + bytes(78), peer.address, time.monotonic_ns())])
            assert len(door._answers) == 64

    run(story)


def test_a_second_daemon_on_the_port_leaves_the_first_ones_journal_alone(peer: Peer) -> None:
    async def story() -> None:
        with Doorstep(peer.config) as first, Doorstep(peer.config) as second:
            await first.step()
            with pytest.raises(UdpError, match="the port is in use"):
                await second.step()
            assert second.journal is None

    run(story)

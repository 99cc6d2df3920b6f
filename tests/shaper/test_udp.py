"""The UDP socket on loopback: no sleeps, each wait bounded and ended by what is waited for."""

import asyncio
import socket
import time
from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from shaper.udp import UdpError, UdpLink

TIMEOUT_S = 5


def free_address() -> tuple[str, int]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return "127.0.0.1", int(probe.getsockname()[1])


def run(story: Callable[[], Coroutine[Any, Any, None]]) -> None:
    asyncio.run(asyncio.wait_for(story(), TIMEOUT_S))


def test_datagrams_go_to_the_peer_and_come_from_it() -> None:
    async def story() -> None:
        a, b = free_address(), free_address()
        inbox: asyncio.Queue[tuple[str, bytes]] = asyncio.Queue()
        at_a = await UdpLink.open(a, b, lambda ds: [inbox.put_nowait(("a", d)) for d, _, _ in ds])
        at_b = await UdpLink.open(b, a, lambda ds: [inbox.put_nowait(("b", d)) for d, _, _ in ds])
        at_a.send(b"to b", b)
        assert await inbox.get() == ("b", b"to b")
        at_b.send(b"to a", a)
        assert await inbox.get() == ("a", b"to a")
        at_a.close()
        at_b.close()

    run(story)


def test_each_datagram_comes_with_the_address_that_sent_it() -> None:
    async def story() -> None:
        a, b = free_address(), free_address()
        inbox: asyncio.Queue[tuple[bytes, tuple[str, int]]] = asyncio.Queue()
        link = await UdpLink.open(a, b, lambda ds: [inbox.put_nowait((d, s)) for d, s, _ in ds])
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.bind(("127.0.0.1", 0))
            stranger.sendto(b"hello", a)
            assert await inbox.get() == (b"hello", stranger.getsockname())
        assert link.peer == b
        link.close()

    run(story)


def test_a_datagram_is_stamped_when_the_kernel_had_it_however_late_the_loop_reads_it() -> None:
    async def story() -> None:
        a, b = free_address(), free_address()
        inbox: asyncio.Queue[int] = asyncio.Queue()
        link = await UdpLink.open(a, b, lambda ds: [inbox.put_nowait(at_ns) for _, _, at_ns in ds])
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
            sent_ns = time.monotonic_ns()
            peer.sendto(b"hello", a)
            while time.monotonic_ns() < sent_ns + 60_000_000:  # a loop that is busy with something else
                pass
            assert 0 <= await inbox.get() - sent_ns < 50_000_000
        link.close()

    run(story)


@pytest.mark.parametrize("unix_step_ns", [3_600_000_000_000, -3_600_000_000_000])
def test_a_stepped_wall_clock_does_not_reach_the_stamps(
    monkeypatch: pytest.MonkeyPatch, unix_step_ns: int
) -> None:
    unix_ns = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: unix_ns() + unix_step_ns)

    async def story() -> None:
        a, b = free_address(), free_address()
        inbox: asyncio.Queue[int] = asyncio.Queue()
        link = await UdpLink.open(a, b, lambda ds: [inbox.put_nowait(at_ns) for _, _, at_ns in ds])
        began_ns = time.monotonic_ns()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
            peer.sendto(b"hello", a)
        assert began_ns <= await inbox.get() <= time.monotonic_ns()
        link.close()

    run(story)


def test_an_absent_peer_is_no_error() -> None:
    async def story() -> None:
        a, b = free_address(), free_address()
        inbox: asyncio.Queue[bytes] = asyncio.Queue()
        link = await UdpLink.open(a, b, lambda ds: [inbox.put_nowait(d) for d, _, _ in ds])
        for _ in range(3):  # the kernel answers "connection refused" by and by
            link.send(b"anyone?", b)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
            peer.bind(b)
            peer.sendto(b"yes", a)
            assert await inbox.get() == b"yes"
        link.close()

    run(story)


def test_a_port_in_use_is_told() -> None:
    async def story() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
            taken.bind(("127.0.0.1", 0))
            port = taken.getsockname()[1]
            with pytest.raises(UdpError, match=f"link.listen = 127.0.0.1:{port}: the port is in use"):
                await UdpLink.open(("127.0.0.1", port), free_address(), lambda d: None)

    run(story)


def test_nothing_is_sent_after_close() -> None:
    async def story() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
            peer.bind(("127.0.0.1", 0))
            peer.settimeout(0.2)
            link = await UdpLink.open(free_address(), peer.getsockname(), lambda d: None)
            link.send(b"in time", peer.getsockname())
            assert peer.recv(100) == b"in time"
            link.close()
            link.send(b"late", peer.getsockname())
            with pytest.raises(TimeoutError):
                peer.recv(100)

    run(story)

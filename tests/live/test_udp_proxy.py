"""The UDP proxy with real sockets and clocks on loopback."""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import pytest

from netem_scripts.band import Band, DirectionProfile, Profile
from netem_scripts.profiles import profile_named
from netem_scripts.records import BandRecord, PacketRecord
from netem_scripts.udp_proxy import ProxyError, ProxyReport, ProxySettings, precise_event_loop, run_proxy

pytestmark = pytest.mark.live

HOST = "127.0.0.1"
MS = 1_000_000


@dataclass
class Ends:
    """The two programs, and the proxy's ports that they send to."""

    robot: socket.socket
    operator: socket.socket
    robot_side: tuple[str, int]
    operator_side: tuple[str, int]


def bound() -> socket.socket:
    end = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    end.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    end.bind((HOST, 0))
    end.setblocking(False)
    return end


@contextmanager
def ends() -> Iterator[Ends]:
    sockets = [bound() for _ in range(4)]
    robot, operator, *placeholders = sockets
    ports = [placeholder.getsockname() for placeholder in placeholders]
    for placeholder in placeholders:
        placeholder.close()
    yield Ends(robot, operator, ports[0], ports[1])
    robot.close()
    operator.close()


def named(address: tuple[str, int]) -> str:
    return f"{address[0]}:{address[1]}"


def through_proxy(
    at: Ends,
    profile: str | Profile,
    talk: Callable[[], Awaitable[None]],
    on_packet: Callable[[PacketRecord], None] | None = None,
    on_band: Callable[[BandRecord], None] | None = None,
) -> ProxyReport:
    """Run `talk` while the proxy carries; the peers are learnt."""
    resolved = profile_named(profile) if isinstance(profile, str) else profile
    settings = ProxySettings(resolved, named(at.robot_side), named(at.operator_side))

    async def both() -> ProxyReport:
        stop, ready = asyncio.Event(), asyncio.Event()
        proxy = asyncio.create_task(
            run_proxy(settings, stop=stop, ready=ready, on_packet=on_packet, on_band=on_band)
        )
        await ready.wait()
        try:
            await talk()
        finally:
            stop.set()
        return await asyncio.wait_for(proxy, 5)

    with asyncio.Runner(loop_factory=precise_event_loop) as runner:
        return runner.run(both())


async def received(end: socket.socket) -> bytes:
    return await asyncio.wait_for(asyncio.get_running_loop().sock_recv(end, 2048), 5)


@pytest.mark.exact
def test_datagrams_arrive_in_order_when_the_link_says() -> None:
    """200 datagrams in 1 s at 200 kbit/s: 128 bytes on the wire are 5.12 ms of service and 20 ms of delay."""
    packets: list[PacketRecord] = []
    band_records: list[BandRecord] = []
    delays_ns: list[int] = []
    numbers: list[int] = []

    with ends() as at:

        async def talk() -> None:
            at.operator.sendto(b"here I am", at.operator_side)  # the proxy learns where to deliver
            await asyncio.sleep(0.05)
            await asyncio.gather(send(), receive())

        async def send() -> None:
            begin_ns = time.monotonic_ns()
            for number in range(200):
                due_ns = begin_ns + number * 5 * MS
                await asyncio.sleep(max(0, due_ns - time.monotonic_ns()) / 1e9)
                stamp = number.to_bytes(4, "big") + time.monotonic_ns().to_bytes(8, "big")
                at.robot.sendto(stamp.ljust(100), at.robot_side)

        async def receive() -> None:
            for _ in range(200):
                data = await received(at.operator)
                numbers.append(int.from_bytes(data[:4], "big"))
                delays_ns.append(time.monotonic_ns() - int.from_bytes(data[4:12], "big"))

        report = through_proxy(at, "constant-200k-20ms", talk, packets.append, band_records.append)

    down = [packet for packet in packets if packet.direction == "down"]
    assert numbers == list(range(200))
    assert (report.down.received, report.down.sent, report.down.kernel_drops) == (200, 200, 0)
    assert {(band.direction, band.rate_bps, band.one_way_delay_ns) for band in band_records} == {
        ("down", 200_000, 20 * MS),
        ("up", 200_000, 20 * MS),
    }
    service_and_delay_ns = 5_120_000 + 20 * MS
    late_ns = sorted(
        delay_ns - packet.queue_delay_ns - service_and_delay_ns
        for delay_ns, packet in zip(delays_ns, down, strict=True)
    )
    assert late_ns[0] >= 0
    assert late_ns[100] < 3 * MS  # about 0.5 ms when the machine is quiet; p95 below 2 ms
    assert late_ns[190] < 25 * MS


def test_replies_come_back_from_the_port_that_was_sent_to_and_a_restart_is_followed() -> None:
    with ends() as at:
        restarted = bound()

        async def talk() -> None:
            at.robot.sendto(b"first", at.robot_side)
            await asyncio.sleep(0.02)
            at.operator.sendto(b"to the first", at.operator_side)
            loop = asyncio.get_running_loop()
            assert await loop.sock_recvfrom(at.robot, 2048) == (b"to the first", at.robot_side)
            restarted.sendto(b"second", at.robot_side)
            assert await received(at.operator) == b"second"
            at.operator.sendto(b"to the second", at.operator_side)
            assert await received(restarted) == b"to the second"

        report = through_proxy(at, "constant-1m-0ms", talk)
        restarted.close()
    assert report.down.undeliverable == 1  # "first": nobody had spoken from the operator's side yet
    assert (report.down.sent, report.up.sent) == (1, 2)


def test_a_corrupted_datagram_arrives_with_one_bit_flipped_and_a_large_one_does_not() -> None:
    band = Band(60_000 * MS, 10_000_000, 0, corrupt_ratio=1.0)
    direction = DirectionProfile((band,), mtu_bytes=128)
    arrived: list[bytes] = []

    with ends() as at:

        async def talk() -> None:
            at.operator.sendto(b"here I am", at.operator_side)
            await asyncio.sleep(0.05)
            for size in (101, 100, 50):
                at.robot.sendto(bytes(size), at.robot_side)
            for _ in range(2):
                arrived.append(await received(at.operator))

        report = through_proxy(at, Profile("noisy", direction, direction), talk)
    assert [len(data) for data in arrived] == [100, 50]
    assert all(int.from_bytes(data, "big").bit_count() == 1 for data in arrived)
    assert (report.down.received, report.down.dropped_by_link, report.down.corrupted) == (3, 1, 2)


def test_each_band_change_is_told_at_its_instant_once_per_direction() -> None:
    cycle = (Band(40 * MS, 1_000_000, 0), Band(60 * MS, 100_000, 0))
    records: list[BandRecord] = []

    async def talk() -> None:
        await asyncio.sleep(0.22)

    with ends() as at:
        once, again = DirectionProfile(cycle), DirectionProfile(cycle, cyclic=True)
        through_proxy(at, Profile("steps", down=again, up=once), talk, on_band=records.append)
    start_ns = records[0].t_ns
    down = [((r.t_ns - start_ns) // MS, r.rate_bps) for r in records if r.direction == "down"]
    up = [((r.t_ns - start_ns) // MS, r.rate_bps) for r in records if r.direction == "up"]
    changes = [(0, 1_000_000), (40, 100_000), (100, 1_000_000), (140, 100_000), (200, 1_000_000)]
    assert down[:5] == changes
    assert up == changes[:2]


def test_a_port_in_use_is_a_sentence_that_names_it() -> None:
    with ends() as at:
        taken = named(at.operator.getsockname())
        settings = ProxySettings(profile_named("trials"), named(at.robot_side), taken)
        with pytest.raises(ProxyError, match=f"operator_side = {taken}: Address already in use"):
            asyncio.run(run_proxy(settings, stop=asyncio.Event()))


def test_both_ports_are_free_again_after_the_stop() -> None:
    async def talk() -> None:
        await asyncio.sleep(0)

    with ends() as at:
        through_proxy(at, "trials", talk)
        through_proxy(at, "trials", talk)


@pytest.mark.parametrize(
    "address", ["9000", "host:", "127.0.0.1:0", "127.0.0.1:65536", ":9000", "127.0.0.1:x"]
)
def test_an_address_that_is_none_is_refused(address: str) -> None:
    settings = ProxySettings(profile_named("trials"), address, "127.0.0.1:9")
    with pytest.raises(ProxyError, match=f"robot_side = {address} must be"):
        asyncio.run(run_proxy(settings, stop=asyncio.Event()))

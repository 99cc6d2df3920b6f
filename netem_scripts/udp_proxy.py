"""A link between two UDP programs in real time: what enters one port leaves the other when the link says.

robot's shaper  <-->  robot side | Link down | operator side  <-->  operator's shaper
                                 | Link up   |
"""

from __future__ import annotations

import asyncio
import random
import selectors
import socket
import struct
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from heapq import heappop, heappush

from .band import Profile
from .link import Link
from .records import BandRecord, Direction, PacketRecord

# Large enough for 4 s of a 1 Mbit/s link in a process that is not scheduled; the kernel may grant less.
SOCKET_BUFFER_BYTES = 1 << 19
MAX_PAYLOAD_BYTES = 65_535
DATAGRAMS_PER_TURN = 64  # read at most so many before looking at the other side and at what is due
_SO_RXQ_OVFL = 40  # Linux, asm-generic/socket.h: the kernel reports its drops beside the next datagram

Address = tuple[str, int]


class ProxyError(Exception):
    """The proxy cannot start; the message names the address."""


@dataclass(frozen=True, slots=True)
class ProxySettings:
    """Where the proxy listens and delivers; addresses are "host:port" or "[host]:port".

    robot_side, operator_side: where the robot's and the operator's program send to.
    robot_peer, operator_peer: where those programs listen; None learns it from the last datagram that came
        to that side, so that a program may come back on another port.
    """

    profile: Profile
    robot_side: str
    operator_side: str
    robot_peer: str | None = None
    operator_peer: str | None = None
    seed: int = 0


@dataclass(slots=True)
class ProxyCounts:
    """Datagrams of one direction.

    received = dropped_by_link + (sent - duplicated) + undeliverable + still waiting at the stop. Datagrams
    that the kernel threw away were never received: kernel_drops above 0 means that the numbers of this run
    are not the link's (the kernel tells with the next datagram that it does pass on). undeliverable: the
    kernel refused it, or nobody had spoken from there yet. worst_lateness_ns: how far behind the link's
    instant a datagram was sent.
    """

    received: int = 0
    dropped_by_link: int = 0
    duplicated: int = 0
    sent: int = 0
    undeliverable: int = 0
    kernel_drops: int = 0
    worst_lateness_ns: int = 0


@dataclass(frozen=True, slots=True)
class ProxyReport:
    """What went through, per direction."""

    down: ProxyCounts
    up: ProxyCounts


def precise_event_loop() -> asyncio.AbstractEventLoop:
    """A loop whose timers count microseconds: asyncio.Runner(loop_factory=precise_event_loop).

    The usual one waits in epoll, in whole milliseconds rounded up twice, and is up to 2 ms late.
    """
    return asyncio.SelectorEventLoop(selectors.SelectSelector())


async def run_proxy(
    settings: ProxySettings,
    *,
    stop: asyncio.Event,
    on_packet: Callable[[PacketRecord], None] | None = None,
    on_band: Callable[[BandRecord], None] | None = None,
    ready: asyncio.Event | None = None,
) -> ProxyReport:
    """Carry datagrams until `stop` is set; what is still in the link then is gone.

    The schedule begins when both ports are open, which is when `ready` is set. Runs on any event loop, most
    exactly on that of precise_event_loop. Raises ProxyError.
    """
    robot = _Side("robot_side", settings.robot_side, settings.robot_peer)
    try:
        operator = _Side("operator_side", settings.operator_side, settings.operator_peer)
    except ProxyError:
        robot.socket.close()
        raise
    proxy = _Proxy(settings, robot, operator, on_packet, on_band)
    try:
        proxy.start()
        if ready is not None:
            ready.set()
        await stop.wait()
    finally:
        proxy.close()
    return ProxyReport(down=proxy.down.counts, up=proxy.up.counts)


class _Side:
    """One port of the proxy and the program that talks to it."""

    def __init__(self, name: str, address: str, peer: str | None) -> None:
        family, bind_to = _resolve(name, address)
        self.learns = peer is None
        self.peer: Address | None = None
        if peer is not None:
            peer_family, self.peer = _resolve(name.replace("_side", "_peer"), peer)
            if peer_family != family:
                raise ProxyError(f"{name} = {address} and its peer {peer} must both be IPv4 or both IPv6.")
        self.socket = socket.socket(family, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
            self.socket.setsockopt(socket.SOL_SOCKET, option, SOCKET_BUFFER_BYTES)
        if sys.platform == "linux":
            self.socket.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
        try:
            self.socket.bind(bind_to)
        except OSError as error:
            self.socket.close()
            reason = error.strerror or str(error)
            raise ProxyError(f"The link cannot listen on {name} = {address}: {reason}.") from error


@dataclass(slots=True)
class _Way:
    """One direction of traffic."""

    direction: Direction
    link: Link
    origin: _Side
    destination: _Side
    counts: ProxyCounts = field(default_factory=ProxyCounts)


class _Proxy:
    def __init__(
        self,
        settings: ProxySettings,
        robot: _Side,
        operator: _Side,
        on_packet: Callable[[PacketRecord], None] | None,
        on_band: Callable[[BandRecord], None] | None,
    ) -> None:
        profile, seed = settings.profile, settings.seed
        self.down = _Way("down", Link(profile.down, random.Random(f"{seed} down")), robot, operator)
        self.up = _Way("up", Link(profile.up, random.Random(f"{seed} up")), operator, robot)
        self._on_packet = on_packet
        self._on_band = on_band
        self._loop = asyncio.get_running_loop()
        self._start_ns = 0
        self._due: list[tuple[int, int, _Way, bytes]] = []  # heap: arrival_ns, serial, ...
        self._serial = 0
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at_ns = 0
        self._band_timers: dict[Direction, asyncio.TimerHandle] = {}

    def start(self) -> None:
        self._start_ns = time.monotonic_ns()
        for way in (self.down, self.up):
            self._loop.add_reader(way.origin.socket, self._receive, way)
            self._announce_band(way, 0)

    def close(self) -> None:
        for timer in (self._timer, *self._band_timers.values()):
            if timer is not None:
                timer.cancel()
        for way in (self.down, self.up):
            self._loop.remove_reader(way.origin.socket)
            way.origin.socket.close()

    def _receive(self, way: _Way) -> None:
        for _ in range(DATAGRAMS_PER_TURN):
            try:
                data, ancillary, _flags, address = way.origin.socket.recvmsg(
                    MAX_PAYLOAD_BYTES, socket.CMSG_SPACE(4)
                )
            except (BlockingIOError, InterruptedError):
                break
            now_ns = time.monotonic_ns()
            for _level, kind, value in ancillary:
                if kind == _SO_RXQ_OVFL:
                    (way.counts.kernel_drops,) = struct.unpack("=I", value)
            if way.origin.learns:
                way.origin.peer = address
            self._enter(way, data, now_ns)
        self._deliver()

    def _enter(self, way: _Way, data: bytes, now_ns: int) -> None:
        passage = way.link.transmit(len(data), now_ns - self._start_ns)
        counts = way.counts
        counts.received += 1
        counts.dropped_by_link += not passage.arrivals_ns
        counts.duplicated += len(passage.arrivals_ns) > 1
        for arrival_ns in passage.arrivals_ns:
            heappush(self._due, (self._start_ns + arrival_ns, self._serial, way, data))
            self._serial += 1
        if self._on_packet is not None:
            self._on_packet(
                PacketRecord(
                    t_ns=now_ns,
                    direction=way.direction,
                    wire_bytes=passage.wire_bytes,
                    queue_delay_ns=passage.queue_delay_ns,
                    dropped=passage.drop,
                )
            )

    def _deliver(self) -> None:
        """Send what is due and set the timer for what is due next."""
        due = self._due
        while due and due[0][0] <= time.monotonic_ns():
            arrival_ns, _, way, data = heappop(due)
            self._send(way, data)
            late_ns = time.monotonic_ns() - arrival_ns
            way.counts.worst_lateness_ns = max(way.counts.worst_lateness_ns, late_ns)
        if due and (self._timer is None or due[0][0] != self._timer_at_ns):
            if self._timer is not None:
                self._timer.cancel()
            self._timer_at_ns = due[0][0]
            self._timer = self._loop.call_at(self._timer_at_ns / 1e9, self._on_timer)

    def _send(self, way: _Way, data: bytes) -> None:
        if way.destination.peer is None:
            way.counts.undeliverable += 1
            return
        try:
            way.destination.socket.sendto(data, way.destination.peer)
            way.counts.sent += 1
        except OSError:  # a full send buffer, no route, too long: counted, as it is not the link's doing
            way.counts.undeliverable += 1

    def _on_timer(self) -> None:
        self._timer = None
        self._deliver()

    def _announce_band(self, way: _Way, at_ns: int) -> None:
        band = way.link.band_at(at_ns)
        if self._on_band is not None:
            self._on_band(
                BandRecord(self._start_ns + at_ns, way.direction, band.rate_bps, band.one_way_delay_ns)
            )
        change_ns = way.link.next_change_ns(at_ns)
        if change_ns is not None:
            at_s = (self._start_ns + change_ns) / 1e9
            timer = self._loop.call_at(at_s, self._announce_band, way, change_ns)
            self._band_timers[way.direction] = timer


def _resolve(name: str, address: str) -> tuple[socket.AddressFamily, Address]:
    host, separator, port = address.rpartition(":")
    if not separator or not host or not port.isascii() or not port.isdigit() or not 0 < int(port) < 65_536:
        raise ProxyError(f'{name} = {address} must be "host:port" with a port from 1 to 65535.')
    try:
        found = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_DGRAM)
    except OSError as error:
        raise ProxyError(f"{name} = {address}: the host is unknown: {error.strerror}.") from error
    family, _, _, _, socket_address = found[0]
    return family, (str(socket_address[0]), int(socket_address[1]))

"""A link between two UDP programs in real time: what enters one port leaves the other when the link says.

robot's shaper  <-->  robot side | Link down | operator side  <-->  operator's shaper
                                 | Link up   |
"""

from __future__ import annotations

import asyncio
import socket
import struct
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

from .band import Profile
from .carrier import Carrier, LinkCounts, LinkReport, Way, precise_event_loop
from .records import BandRecord, PacketRecord

__all__ = ["ProxyCounts", "ProxyError", "ProxyReport", "ProxySettings", "precise_event_loop", "run_proxy"]

ProxyCounts = LinkCounts
ProxyReport = LinkReport

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
    carrier = Carrier(settings.profile, settings.seed, operator.send, robot.send, on_packet, on_band)
    loop = asyncio.get_running_loop()
    try:
        carrier.start()
        for side, way in ((robot, carrier.down), (operator, carrier.up)):
            loop.add_reader(side.socket, _receive, carrier, side, way)
        if ready is not None:
            ready.set()
        await stop.wait()
    finally:
        carrier.close()
        for side in (robot, operator):
            loop.remove_reader(side.socket)
            side.socket.close()
    return carrier.report()


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

    def send(self, data: bytes) -> bool:
        """Deliver to this side's program; False when it is not known yet."""
        if self.peer is None:
            return False
        self.socket.sendto(data, self.peer)
        return True


def _receive(carrier: Carrier, side: _Side, way: Way) -> None:
    for _ in range(DATAGRAMS_PER_TURN):
        try:
            data, ancillary, _flags, address = side.socket.recvmsg(MAX_PAYLOAD_BYTES, socket.CMSG_SPACE(4))
        except (BlockingIOError, InterruptedError):
            break
        now_ns = time.monotonic_ns()
        for _level, kind, value in ancillary:
            if kind == _SO_RXQ_OVFL:  # the kernel tells with the next datagram that it does pass on
                (way.counts.kernel_drops,) = struct.unpack("=I", value)
        if side.learns:
            side.peer = address
        carrier.enter(way, data, now_ns)
    carrier.deliver_due()


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

"""The link between two network namespaces: any IP program runs in them unmodified.

COMMAND_A in robot's namespace -- TUN device | Link down | TUN device -- COMMAND_B in operator's namespace
                                             | Link up   |

What is charged is the IP packet; a profile's overhead beyond IP and UDP (28 bytes) is added to it.
"""

from __future__ import annotations

import asyncio
import fcntl
import os
import socket
import struct
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from .band import IP_UDP_HEADER_BYTES, Profile
from .carrier import Carrier, Way, precise_event_loop
from .container import Container
from .network import (
    DEVICE,
    DEVICE_MTU_BYTES,
    NETMASK,
    OPERATOR_ADDRESS,
    ROBOT_ADDRESS,
    default_route,
    interface_request,
)
from .records import BandRecord, PacketRecord
from .sides import SidesReport, run_sides

_TUNSETIFF, _IFF_TUN, _IFF_NO_PI = 0x400454CA, 0x0001, 0x1000
_SIOCADDRT, _SIOCGIFFLAGS, _SIOCSIFFLAGS, _SIOCSIFADDR, _SIOCSIFNETMASK, _SIOCSIFMTU = (
    0x890B, 0x8913, 0x8914, 0x8916, 0x891C, 0x8922,
)  # fmt: skip
_IFF_UP, _IFF_RUNNING, _IFF_MULTICAST = 0x1, 0x40, 0x1000
_PACKETS_PER_TURN = 64
_MAX_PACKET_BYTES = 65_535


@dataclass(frozen=True, slots=True)
class TunSettings:
    """What runs where. linger_s: how long the operator's command may go on after the robot's has ended."""

    profile: Profile
    robot_command: Sequence[str]
    operator_command: Sequence[str]
    seed: int = 0
    linger_s: float = 15.0


def run_tun(
    settings: TunSettings,
    *,
    on_packet: Callable[[PacketRecord], None] | None = None,
    on_band: Callable[[BandRecord], None] | None = None,
) -> SidesReport:
    """Run both commands with the link between them until they have ended. Raises ContainerError.

    The schedule begins as the commands do. SIGTERM or SIGINT ends both commands, exit code 128 + the signal.
    """
    sides = [
        Container("robot", settings.robot_command, ("tun", ROBOT_ADDRESS)),
        Container("operator", settings.operator_command, ("tun", OPERATOR_ADDRESS)),
    ]
    try:
        devices = [_device(side) for side in sides]
        with asyncio.Runner(loop_factory=precise_event_loop) as runner:
            return runner.run(_carry(settings, sides, devices, on_packet, on_band))
    finally:
        for side in sides:
            side.stop()


def prepare_tun(arguments: Sequence[str]) -> int:
    """Inside a namespace: a TUN device with an address, up, and the way to everywhere. Its descriptor."""
    (address,) = arguments
    device = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    name = DEVICE.encode()
    fcntl.ioctl(device, _TUNSETIFF, struct.pack("16sH22x", name, _IFF_TUN | _IFF_NO_PI))
    ipv6 = Path(f"/proc/sys/net/ipv6/conf/{DEVICE}/disable_ipv6")
    if ipv6.exists():
        ipv6.write_text("1")  # or the kernel's own router and listener reports would cross the link
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        _raise_flags(control, b"lo", _IFF_UP | _IFF_RUNNING)
        fcntl.ioctl(control, _SIOCSIFADDR, interface_request(DEVICE, address))
        fcntl.ioctl(control, _SIOCSIFNETMASK, interface_request(DEVICE, NETMASK))
        fcntl.ioctl(control, _SIOCSIFMTU, struct.pack("16si12x", name, DEVICE_MTU_BYTES))
        _raise_flags(control, name, _IFF_UP | _IFF_RUNNING | _IFF_MULTICAST)
        route, _memory = default_route(DEVICE)
        fcntl.ioctl(control, _SIOCADDRT, route)
    return device


def _raise_flags(control: socket.socket, device: bytes, flags: int) -> None:
    request = fcntl.ioctl(control, _SIOCGIFFLAGS, struct.pack("16sh14x", device, 0))
    (present,) = struct.unpack_from("h", request, 16)
    fcntl.ioctl(control, _SIOCSIFFLAGS, struct.pack("16sh14x", device, present | flags))


def _device(side: Container) -> int:
    descriptor = side.wait_ready()
    assert descriptor is not None, "prepare_tun opens one"
    return descriptor


async def _carry(
    settings: TunSettings,
    sides: Sequence[Container],
    devices: Sequence[int],
    on_packet: Callable[[PacketRecord], None] | None,
    on_band: Callable[[BandRecord], None] | None,
) -> SidesReport:
    robot, operator = devices
    loop = asyncio.get_running_loop()
    carrier = Carrier(settings.profile, settings.seed, _writer(operator), _writer(robot), on_packet, on_band)
    try:
        for device, way in ((robot, carrier.down), (operator, carrier.up)):
            loop.add_reader(device, _read, carrier, device, way)
        carrier.start()
        ended = await run_sides(sides[0], sides[1], settings.linger_s)
    finally:
        carrier.close()
        for device in devices:
            loop.remove_reader(device)
            os.close(device)
    return replace(ended, link=carrier.report())


def _read(carrier: Carrier, device: int, way: Way) -> None:
    for _ in range(_PACKETS_PER_TURN):
        try:
            packet = os.read(device, _MAX_PACKET_BYTES)
        except (BlockingIOError, InterruptedError):
            break
        carrier.enter(way, packet, time.monotonic_ns(), IP_UDP_HEADER_BYTES)
    carrier.deliver_due()


def _writer(device: int) -> Callable[[bytes], bool]:
    def write(packet: bytes) -> bool:
        return os.write(device, packet) == len(packet)

    return write

"""Two namespaces joined by a pair of virtual Ethernet devices with the kernel's netem on both.

It takes a kernel with sch_netem and veth; where the host's has none, netem_scripts.guest boots one.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from .band import Profile
from .carrier import precise_event_loop
from .container import Container
from .network import DEVICE, DEVICE_MTU_BYTES, NETMASK_BITS, OPERATOR_ADDRESS, ROBOT_ADDRESS
from .sides import SidesReport, run_sides
from .tc import PACKET_BYTES, Interface, NetemSchedule, TcError, run

_MACS = ("02:00:00:00:47:01", "02:00:00:00:47:02")


@dataclass(frozen=True, slots=True)
class VethSettings:
    """What runs where; as TunSettings. packet_bytes: the packets that the buffer is counted in."""

    profile: Profile
    robot_command: Sequence[str]
    operator_command: Sequence[str]
    linger_s: float = 15.0
    packet_bytes: int = PACKET_BYTES


def run_veth(settings: VethSettings) -> SidesReport:
    """Run both commands with netem between them until they have ended. Raises ContainerError, TcError.

    The schedule begins as the commands do; a band's change is verified by reading it back.
    """
    sides = (Container("robot", settings.robot_command), Container("operator", settings.operator_command))
    try:
        for side in sides:
            side.wait_ready()
        interfaces = _join(*sides)
        schedules = [
            NetemSchedule(direction, interface, settings.packet_bytes)
            for direction, interface in zip(
                (settings.profile.down, settings.profile.up), interfaces, strict=True
            )
        ]
        for schedule in schedules:
            schedule.apply(0)
        with asyncio.Runner(loop_factory=precise_event_loop) as runner:
            return runner.run(_follow(settings, sides, schedules))
    finally:
        for side in sides:
            side.stop()


async def _follow(
    settings: VethSettings, sides: tuple[Container, Container], schedules: Sequence[NetemSchedule]
) -> SidesReport:
    start_ns = time.monotonic_ns()
    changes = [
        asyncio.ensure_future(_change(schedule, side, start_ns))
        for schedule, side in zip(schedules, sides, strict=True)
    ]
    ended = asyncio.ensure_future(run_sides(*sides, settings.linger_s))
    try:
        await asyncio.wait([ended, *changes], return_when=asyncio.FIRST_COMPLETED)
        for change in changes:
            if change.done():
                change.result()  # raises what tc said
        return await ended
    finally:
        for task in (*changes, ended):
            task.cancel()
        await asyncio.gather(*changes, ended, return_exceptions=True)


async def _change(schedule: NetemSchedule, side: Container, start_ns: int) -> None:
    """Follow the schedule on one side for as long as the side is there."""
    at_ns = 0
    while True:
        change_ns = schedule.next_change_ns(at_ns)
        if change_ns is None:
            await asyncio.Event().wait()  # the last band lasts for ever
            return
        await asyncio.sleep(max(0, start_ns + change_ns - time.monotonic_ns()) / 1e9)
        at_ns = change_ns
        try:
            schedule.apply(at_ns)
        except TcError:
            if side.process.poll() is None:
                raise
            await asyncio.Event().wait()  # the side has just ended, and its device with it


def _join(robot: Container, operator: Container) -> tuple[Interface, Interface]:
    """Make the pair and bring it up: fixed neighbours, no IPv6, no segments to be cut by the device."""
    pids = (str(robot.pid), str(operator.pid))
    pair = ["ip", "link", "add", DEVICE, "netns", pids[0], "address", _MACS[0], "type", "veth"]
    run([*pair, "peer", "name", DEVICE, "netns", pids[1], "address", _MACS[1]])
    addresses = (ROBOT_ADDRESS, OPERATOR_ADDRESS)
    interfaces = (Interface(DEVICE, robot.pid), Interface(DEVICE, operator.pid))
    for index, interface in enumerate(interfaces):
        there = 1 - index
        lines = [
            "link set lo up",
            f"link set {DEVICE} gso_max_segs 1",
            f"link set {DEVICE} mtu {DEVICE_MTU_BYTES} up",
            f"address add {addresses[index]}/{NETMASK_BITS} dev {DEVICE}",
            f"neighbour add {addresses[there]} lladdr {_MACS[there]} dev {DEVICE} nud permanent",
            f"route add default dev {DEVICE}",
        ]
        if Path("/proc/net/if_inet6").exists():  # else the kernel's router solicitations would cross
            lines.insert(0, f"link set {DEVICE} addrgenmode none")
        run(interface.command("ip", "-batch", "-"), "\n".join(lines))
    return interfaces

"""The two programs at the ends of a link: let go together, waited for, told to end."""

from __future__ import annotations

import asyncio
import os
import signal
from dataclasses import dataclass
from typing import Any

from .carrier import LinkReport
from .container import Container


@dataclass(frozen=True, slots=True)
class SidesReport:
    """How the two commands ended; None: it was told to end. link: what went through, if we carried it."""

    robot_code: int
    operator_code: int | None
    link: LinkReport | None = None

    @property
    def exit_code(self) -> int:
        """The robot's command's, else the operator's if it ended by itself."""
        return self.robot_code or self.operator_code or 0


async def run_sides(robot: Container, operator: Container, linger_s: float) -> SidesReport:
    """Let both go and wait for the robot's; the operator's has linger_s after it.

    SIGTERM or SIGINT ends the wait with exit code 128 + the signal. A server that is told to end after the
    robot's command is no failure.
    """
    loop = asyncio.get_running_loop()
    stopped: asyncio.Future[int] = loop.create_future()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, _stop, stopped, number)
    ends: list[asyncio.Future[None]] = [asyncio.ensure_future(_ended(side)) for side in (robot, operator)]
    try:
        for side in (operator, robot):
            side.go()
        for end, timeout_s in zip(ends, (None, linger_s), strict=True):
            awaited: list[asyncio.Future[Any]] = [end, stopped]
            await asyncio.wait(awaited, timeout=timeout_s, return_when=asyncio.FIRST_COMPLETED)
            if stopped.done():
                break
        if stopped.done():
            return SidesReport(128 + stopped.result(), None)
        return SidesReport(robot.stop(), operator.stop() if ends[1].done() else None)
    finally:
        for task in ends:
            task.cancel()
        await asyncio.gather(*ends, return_exceptions=True)


def _stop(stopped: asyncio.Future[int], number: int) -> None:
    if not stopped.done():
        stopped.set_result(number)


async def _ended(side: Container) -> None:
    """Wait for the holder without a thread and without taking its exit code."""
    loop = asyncio.get_running_loop()
    watched = os.pidfd_open(side.pid)
    ended = asyncio.Event()
    loop.add_reader(watched, ended.set)
    try:
        await ended.wait()
    finally:
        loop.remove_reader(watched)
        os.close(watched)

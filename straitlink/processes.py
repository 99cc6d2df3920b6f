"""Long-running parts as processes: exact timers, and a clean stop on SIGTERM and SIGINT."""

from __future__ import annotations

import asyncio
import signal
import time
from collections.abc import Callable, Coroutine, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from netem_scripts.band import Profile
from netem_scripts.records import LinkRecord, StartRecord
from netem_scripts.trace import LinkTrace
from netem_scripts.udp_proxy import ProxyReport, ProxySettings, precise_event_loop, run_proxy

T = TypeVar("T")


def run_until_signal(work: Callable[[asyncio.Event], Coroutine[object, object, T]]) -> T:
    """Run `work(stop)` on a loop with microsecond timers; SIGTERM or SIGINT sets `stop`."""
    with asyncio.Runner(loop_factory=precise_event_loop) as runner:
        return runner.run(_until_signal(work))


async def _until_signal(work: Callable[[asyncio.Event], Coroutine[object, object, T]]) -> T:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    return await work(stop)


async def run_link(settings: ProxySettings, trace: Path | None, stop: asyncio.Event) -> ProxyReport:
    """The emulator between two UDP ports, with each packet's fate in a trace."""
    with link_trace(trace, settings.profile) as write:
        return await run_proxy(settings, stop=stop, on_packet=write, on_band=write)


@contextmanager
def link_trace(trace: Path | None, profile: Profile) -> Iterator[Callable[[LinkRecord], None] | None]:
    """What writes a link's records to a file, begun with the profile; None when no file is wanted."""
    if trace is None:
        yield None
        return
    trace.parent.mkdir(parents=True, exist_ok=True)
    with LinkTrace(trace) as file:
        file.write(StartRecord(time.monotonic_ns(), time.time_ns(), profile))
        yield file.write

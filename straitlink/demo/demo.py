"""The demonstration from start to report, on one screen."""

from __future__ import annotations

import json
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import FrameType

from rich.console import Console
from rich.live import Live

from netem_scripts.profiles import load_profile
from straitlink.demo.children import Child, Children
from straitlink.demo.configs import (
    KEY_FILE,
    Addresses,
    OwnConfigs,
    check_configs,
    free_addresses,
    write_configs,
)
from straitlink.demo.errors import DemoError
from straitlink.demo.log_topics import LogTopic, read_log_topics
from straitlink.demo.view import LiveView
from straitlink.recording import recover
from straitlink.report import Summary, read_run, summarise, write_page

_SYNTHETIC_S = 60.0  # of log; repeated for as long as the demonstration lasts
_DRAIN_S = 6.0  # after the last message was published, for what is on its way in the thin band
_OPERATOR_KEYS = "operator/**"
_RECORDING = "operator.mcap"
_MARK = ".straitlink-demo"  # in a folder that demonstrations may overwrite
_PARTS = (
    "robot",
    "operator",
    "link",
    "robot-bus",
    "operator-bus",
    "robot-shaper",
    "operator-shaper",
    "record",
    "perception",
    "views",
    "robot-replay",
    "operator-replay",
)


@dataclass(frozen=True, slots=True)
class DemoSettings:
    """What is shown. log: an MCAP file; None for the synthetic mission. out: folder of the results.

    own: shaper configurations in place of the examples; their addresses, keys and bands are replaced.
    """

    out: Path
    log: Path | None = None
    profile: str = "trials"
    duration_s: float = 150.0
    seed: int = 1
    own: OwnConfigs = field(default_factory=OwnConfigs)


@dataclass(frozen=True, slots=True)
class DemoResult:
    """Where things are, and what came of the run. interrupted: stopped before its time."""

    recording: Path
    page: Path
    summary: Summary
    interrupted: bool


def run_demo(settings: DemoSettings, synthesize: Callable[[Path], None], console: Console) -> DemoResult:
    """Run it. synthesize writes the synthetic log to a path. Raises DemoError, and leaves nothing running."""
    profile = load_profile(settings.profile)
    check_configs(settings.own)
    out = settings.out
    _refuse_a_folder_of_others(out)
    log, topics, unusable = _log_of(settings, synthesize, console)
    _clear(out, [path for path in (log, settings.own.robot, settings.own.operator) if path is not None])
    addresses = free_addresses()
    write_configs(out, addresses, profile, topics, settings.own)
    recording = out / _RECORDING
    with _interruptible() as stop, Children(out) as children:
        sources = _start(children, settings, addresses, log, recording, unusable)
        started_s = time.monotonic()
        _watch(children, sources, settings, stop, console)
        for source in sources:
            source.stop()
        duration_s = time.monotonic() - started_s  # ages grow while nothing is published: not counted
        stop.wait(0.0 if stop.is_set() else _DRAIN_S)
        interrupted = stop.is_set()
    _write_facts(settings, log, duration_s)
    run = read_run(out)
    summary = summarise(run)
    page = write_page(run, summary, out / "report.html")
    return DemoResult(_valid(recording), page, summary, interrupted)


def _refuse_a_folder_of_others(out: Path) -> None:
    """The results of an earlier demonstration are overwritten; nobody else's files are."""
    if out.exists() and not out.is_dir():
        raise DemoError(f"{out} is a file: expected a folder for the results")
    if out.exists() and any(out.iterdir()) and not (out / _MARK).exists():
        raise DemoError(
            f"{out} holds files that are not a demonstration's: choose an empty folder with --out"
        )
    out.mkdir(parents=True, exist_ok=True)
    (out / _MARK).touch()


def _clear(out: Path, inputs: list[Path]) -> None:
    """Remove what an earlier demonstration left; its recording may be the log of this one."""
    names = [f"{name}{suffix}" for name in _PARTS for suffix in (".jsonl", ".log", ".toml", ".journal")]
    for name in (*names, "run.json", "report.html", KEY_FILE, _RECORDING):
        path = out / name
        for given in inputs:
            if path.exists() and given.exists() and path.samefile(given):
                raise DemoError(f"{given} is where this demonstration would write: give another --out")
        path.unlink(missing_ok=True)


def _log_of(
    settings: DemoSettings, synthesize: Callable[[Path], None], console: Console
) -> tuple[Path, tuple[LogTopic, ...] | None, tuple[str, ...]]:
    if settings.log is not None:
        topics, unusable = read_log_topics(settings.log)
        for topic in unusable:
            console.print(f"left out: {topic} cannot be a Zenoh key")
        return settings.log, topics, unusable
    log = settings.out / "mission" / f"synthetic-{_SYNTHETIC_S:.0f}s-seed{settings.seed}.mcap"
    if not log.exists():
        log.parent.mkdir(exist_ok=True)
        partial = log.with_suffix(".partial")
        console.print("making the synthetic mission, once: 60 s of log, 260 MB")
        try:
            synthesize(partial)
        except BaseException:
            partial.unlink(missing_ok=True)
            raise
        partial.rename(log)
    return log, None, ()


def _start(
    children: Children,
    settings: DemoSettings,
    addresses: Addresses,
    log: Path,
    recording: Path,
    unusable: tuple[str, ...],
) -> list[Child]:
    """Buses, link, shapers, recorder, then the sources; each is ready before the next starts."""
    out = settings.out
    for name, endpoint in (("robot-bus", addresses.robot_bus), ("operator-bus", addresses.operator_bus)):
        child = children.start(name, ["bus", "--listen", endpoint])
        children.wait_until(f"the start of {name}", partial(_is_open, child))
    servers = []
    if settings.log is None:  # they take longest to start
        servers.append(children.start("perception", ["perception", str(out / "perception.toml")]))
        servers.append(children.start("views", ["views", "--connect", addresses.operator_bus]))
    link = ["link", "--profile", settings.profile, "--seed", str(settings.seed)]
    link += ["--robot-side", addresses.link_robot, "--operator-side", addresses.link_operator]
    link += ["--robot-peer", addresses.robot_shaper, "--operator-peer", addresses.operator_shaper]
    children.start("link", [*link, "--trace", str(out / "link.jsonl")])
    children.wait_until("the start of the link", partial(_has_begun, out / "link.jsonl"))
    for side in ("operator", "robot"):
        trace = out / f"{side}.jsonl"
        children.start(f"{side}-shaper", ["shaper", str(out / f"{side}.toml"), "--trace", str(trace)])
    for side in ("operator", "robot"):
        begun = partial(_has_begun, out / f"{side}.jsonl")
        children.wait_until(f"the start of the {side}'s shaper", begun)
    carried = [str(out / "robot.toml"), str(out / "operator.toml")]
    record = ["record", str(recording), "--connect", addresses.operator_bus, "--schemas", str(log)]
    recorder = children.start("record", [*record, *(arg for c in carried for arg in ("--config", c))])
    children.wait_until("the start of the recorder", partial(_is_open, recorder))
    for server in servers:
        children.wait_until(f"the start of {server.name}", partial(_is_open, server))
    passes = ["--loop", "0"]
    down = ["replay", str(log), "--connect", addresses.robot_bus, *passes, "--exclude", _OPERATOR_KEYS]
    down += [arg for topic in unusable for arg in ("--exclude", topic)]
    sources = [children.start("robot-replay", down)]
    if settings.log is None:
        up = ["replay", str(log), "--connect", addresses.operator_bus, *passes, "--topics", _OPERATOR_KEYS]
        sources.append(children.start("operator-replay", up))
    return sources


def _is_open(child: Child) -> bool:
    return b"open" in child.log.read_bytes()


def _has_begun(trace: Path) -> bool:
    return trace.exists() and b"\n" in trace.read_bytes()


def _watch(
    children: Children, sources: list[Child], settings: DemoSettings, stop: threading.Event, console: Console
) -> None:
    """Show what happens until the time is up, somebody stops it, or a part fails."""
    view = LiveView(settings.out, settings.duration_s)
    started_s = time.monotonic()
    next_line_s = 10.0
    with Live(console=console, refresh_per_second=2, transient=True) as live:
        while not stop.wait(0.5):
            elapsed_s = time.monotonic() - started_s
            if elapsed_s >= settings.duration_s:
                return
            children.check()
            view.follow()
            if console.is_terminal:
                live.update(view.table(elapsed_s))
            elif elapsed_s >= next_line_s:
                console.print(view.line(elapsed_s))
                next_line_s = 10.0 * math.ceil(elapsed_s / 10.0 + 0.1)


def _write_facts(settings: DemoSettings, log: Path, duration_s: float) -> None:
    facts = {
        "kind": "live",
        "profile": settings.profile,
        "seed": settings.seed,
        "duration_s": round(duration_s, 1),
        "source": log.name,
    }
    (settings.out / "run.json").write_text(json.dumps(facts, indent=1))


def _valid(recording: Path) -> Path:
    """The recording, repaired if its recorder had to be killed."""
    with recording.open("rb") as file:
        file.seek(-8, 2)
        complete = file.read() == b"\x89MCAP0\r\n"
    return recording if complete else recover(recording)


@contextmanager
def _interruptible() -> Iterator[threading.Event]:
    """An event that Ctrl-C and SIGTERM set, instead of tearing the run apart."""
    stop = threading.Event()

    def on_signal(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    before = {number: signal.signal(number, on_signal) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)

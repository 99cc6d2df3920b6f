"""Two shapers with a key of their own, the link emulator between them, and publishers: for wire benches."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import tomlkit

from shaper.bus import BusSettings
from straitlink.demo.configs import KEY_FILE, free_addresses, write_temporary_key

DELAY_MS = 50
BEAT_KEY, COMMAND_KEYS = "robot/heartbeat", {"robot": "robot/done", "operator": "operator/command"}

COMMANDS_AND_BEAT: dict[str, list[dict[str, object]]] = {
    "robot": [{"key": COMMAND_KEYS["robot"], "class": "command"}, {"key": BEAT_KEY, "class": "heartbeat"}],
    "operator": [{"key": COMMAND_KEYS["operator"], "class": "command"}],
}


class WireRig:
    """Processes "robot", "operator" and "link" in a folder; leaving the context ends them."""

    def __init__(
        self,
        folder: Path,
        profile: str = f"constant-1m-{DELAY_MS}ms",
        topics: Mapping[str, Sequence[Mapping[str, object]]] = COMMANDS_AND_BEAT,
        *,
        traced: bool = True,
    ) -> None:
        """topics: tables of `[[topics]]` by side. traced: the shapers write traces; the link always does.

        No side is told what the link carries.
        """
        self.folder = folder
        self._topics = topics
        self._untraced = () if traced else ("robot", "operator")
        self.addresses = a = free_addresses()
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        write_temporary_key(folder)
        link = ["link", "--profile", profile]
        link += ["--robot-side", a.link_robot, "--operator-side", a.link_operator]
        link += ["--robot-peer", a.robot_shaper, "--operator-peer", a.operator_shaper]
        self._commands = {"link": link}
        for side, listen, peer in (
            ("robot", a.robot_shaper, a.link_robot),
            ("operator", a.operator_shaper, a.link_operator),
        ):
            # The buses are processes of their own: they stay when a shaper is killed.
            bus = a.robot_bus if side == "robot" else a.operator_bus
            self._write_config(side, listen, peer, bus)
            self._commands[side] = ["shaper", str(folder / f"{side}.toml")]
            self._commands[f"{side}-bus"] = ["bus", "--listen", bus]

    def _write_config(self, side: str, listen: str, peer: str, bus: str) -> None:
        document = {
            "link": {"side": side, "listen": listen, "peer": peer, "keys": [KEY_FILE]},
            "zenoh": {"connect": [bus]},
            "topics": [dict(table) for table in self._topics[side]],
        }
        (self.folder / f"{side}.toml").write_text(tomlkit.dumps(document))

    def start(self, name: str) -> None:
        """Start a process and wait until it says that it is up."""
        trace = self.folder / f"{name}.jsonl"
        log_path = self.folder / f"{name}.log"
        before, said_bytes = len(self.records(name)), log_path.stat().st_size if log_path.exists() else 0
        arguments = list(self._commands[name])
        traced = not name.endswith("-bus") and name not in self._untraced
        if traced:
            arguments += ["--trace", str(trace)]
        with log_path.open("ab") as log:
            self._running[name] = subprocess.Popen(
                [sys.executable, "-m", "straitlink", *arguments], stdout=log, stderr=log
            )
        if traced:
            wait_until(lambda: len(self.records(name)) > before)
        else:
            says = b"open" if name.endswith("-bus") else b"shaper: "
            wait_until(lambda: says in log_path.read_bytes()[said_bytes:])

    def start_all(self) -> None:
        """Buses, link, shapers."""
        for name in ("robot-bus", "operator-bus", "link", "robot", "operator"):
            self.start(name)

    def kill(self, name: str) -> None:
        """kill -9."""
        self._running[name].kill()
        self._running[name].wait()

    def cpu_s(self, name: str) -> float:
        """Processor time of a process so far (Linux: proc(5), fields 14 and 15 of stat)."""
        fields = Path(f"/proc/{self._running[name].pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def wakeups(self, name: str) -> int:
        """How often threads of a process have waited for something so far (Linux: proc(5), status)."""
        count = 0
        for thread in Path(f"/proc/{self._running[name].pid}/task").iterdir():
            line = next(s for s in (thread / "status").read_text().splitlines() if s.startswith("voluntary"))
            count += int(line.split()[1])
        return count

    def bus(self, side: str) -> BusSettings:
        """How to join the bus of a side."""
        return BusSettings(
            connect=[self.addresses.robot_bus if side == "robot" else self.addresses.operator_bus]
        )

    def records(self, name: str) -> list[dict[str, Any]]:
        """The whole lines of a trace so far."""
        path = self.folder / f"{name}.jsonl"
        if not path.exists():
            return []
        found = []
        for line in path.read_bytes().split(b"\n")[:-1]:
            try:
                found.append(json.loads(line))
            except ValueError:
                continue  # a killed process was writing it
        return found

    def __enter__(self) -> WireRig:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._running.values():
            process.terminate()
        for process in self._running.values():
            try:
                process.wait(8)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def wait_until(condition: Callable[[], bool], timeout_s: float = 30.0) -> None:
    """Poll until something holds. Raises TimeoutError."""
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline_s:
            raise TimeoutError(f"not within {timeout_s} s")
        time.sleep(0.02)

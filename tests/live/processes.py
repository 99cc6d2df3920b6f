"""Real processes on loopback for the live tests: started, waited for with a bound, always stopped."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import tomlkit

from netem_scripts.band import Profile
from netem_scripts.profile_file import profile_to_dict
from shaper.bus import BusSettings
from shaper.config import load_config
from straitlink.demo.configs import KEY_FILE, Addresses, free_addresses, write_temporary_key
from straitlink.mission import Load
from straitlink.mission.mission import preset_bands

ROOT = Path(__file__).resolve().parents[2]


def wait_until(condition: Callable[[], bool], timeout_s: float = 10.0) -> None:
    """Poll until something holds; fails the test when it does not in time."""
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline_s, f"not within {timeout_s} s"
        time.sleep(0.01)


class Rig:
    """Two shapers and the link between them, each a process of its own, with free ports."""

    def __init__(self, folder: Path, profile: Profile, load: Load, estimator: str = "adaptive") -> None:
        """estimator: of both shapers; the profile's bands are a hint to it, or all it knows."""
        self.folder = folder
        self._estimator = estimator
        self.addresses: Addresses = free_addresses()
        self._profile = profile
        self._load = load
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        a = self.addresses
        write_temporary_key(folder)
        self._write_config("robot", a.robot_shaper, a.link_robot, a.robot_bus)
        self._write_config("operator", a.operator_shaper, a.link_operator, a.operator_bus)
        (folder / "profile.toml").write_text(tomlkit.dumps(profile_to_dict(profile)))

    def _write_config(self, side: str, listen: str, peer: str, bus: str) -> None:
        sends: Any = "down" if side == "robot" else "up"
        bands = [
            {"name": b.name, "rate_bps": b.rate_bps, "one_way_delay_ms": b.one_way_delay_ns / 1e6}
            for b in preset_bands(self._profile, sends)
        ]
        topics = []
        for topic in self._load.topics:
            if topic.direction == sends and topic.traffic_class is not None:
                row: dict[str, Any] = {"key": topic.key, "class": topic.traffic_class.name}
                topics.append(row | ({"max_hz": topic.max_hz} if topic.max_hz else {}))
        document = {
            "link": {
                "side": side,
                "listen": listen,
                "peer": peer,
                "estimator": self._estimator,
                "bands": bands,
                "keys": [KEY_FILE],
            },
            "zenoh": {"listen": [bus]},
            "topics": topics,
        }
        path = self.folder / f"{side}.toml"
        path.write_text(tomlkit.dumps(document))
        load_config(path)

    def start(self, name: str) -> None:
        """Start "robot", "operator" or "link", and wait until it is up."""
        a, trace = self.addresses, self.folder / f"{name}.jsonl"
        lines = len(self.records(name))
        if name == "link":
            arguments = ["link", "--profile", str(self.folder / "profile.toml")]
            arguments += ["--robot-side", a.link_robot, "--operator-side", a.link_operator]
            arguments += ["--robot-peer", a.robot_shaper, "--operator-peer", a.operator_shaper]
        else:
            arguments = ["shaper", str(self.folder / f"{name}.toml")]
        self._running[name] = subprocess.Popen(
            [sys.executable, "-m", "straitlink", *arguments, "--trace", str(trace)], cwd=ROOT
        )
        wait_until(lambda: len(self.records(name)) > lines, 15.0)
        if name == "link" and {"robot", "operator"} <= self._running.keys():
            wait_until(lambda: all(self._has_met(side) for side in ("robot", "operator")), 15.0)

    def _has_met(self, side: str) -> bool:
        """Whether the handshake is done: before it nothing crosses, and the newest sample replaces others."""
        return any(record["event"] == "peer_started" for record in self.records(side))

    def kill(self, name: str) -> None:
        """kill -9."""
        self._running[name].kill()
        self._running[name].wait()

    def pid(self, name: str) -> int:
        return self._running[name].pid

    def alive(self, name: str) -> bool:
        return self._running[name].poll() is None

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
        lines = path.read_bytes().split(b"\n")[:-1]
        return [json.loads(line) for line in lines]

    def __enter__(self) -> Rig:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._running.values():
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
        for process in self._running.values():
            try:
                process.wait(8)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def marked_processes(mark: str) -> set[int]:
    """Pids of all processes with this in their environment, which children inherit."""
    found = set()
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit() or int(entry.name) == os.getpid():
            continue
        try:
            environment = (entry / "environ").read_bytes()
        except OSError:
            continue
        if mark.encode() in environment:
            found.add(int(entry.name))
    return found

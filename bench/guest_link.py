"""Live shapers over a real kernel's netem: `python -m bench.guest_link [--profile trials] [--minutes 6]`.

The kernel is user-mode Linux with this host's files (tools/install_guest.sh). Both directions are always
backlogged, nobody is told what the link carries. What netem keeps in its queue is felt by a stranger to the
shapers: datagrams of 40 bytes, five a second each way (2.7 % of 100 kbit/s), whose clock is the kernel's own.
Queueing delay is their delay less the band's own and their serialisation; the band is the slowest one whose
delay they took. Bytes are the interface's count.
"""

from __future__ import annotations

import argparse
import json
import socket
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from bench.machine import provenance
from messages.attachment import Stamp
from netem_scripts.band import Band, Profile
from netem_scripts.profiles import load_profile
from shaper.bus import BusSettings, open_bus
from straitlink.demo.configs import KEY_FILE, write_temporary_key
from straitlink.mission import load_named_or_file

OUT = Path("out/bench/guest_link.json")
ROOT = Path(__file__).resolve().parents[1]
_WAYS = {"robot": "down", "operator": "up"}
_ADDRESSES = {"robot": "10.71.0.1", "operator": "10.71.0.2"}
_BUS, _PORT, _PROBE_PORT = "tcp/127.0.0.1:7447", 9001, 9003
_PROBE_BYTES, _PROBE_INTERVAL_S = 40, 0.2
_PROBE_WIRE_BITS = (_PROBE_BYTES + 28) * 8


@dataclass(frozen=True, slots=True)
class Direction:
    """One direction. used: of what the schedule could carry. queue: milliseconds, by the probes."""

    used: float
    p50_ms: float
    p95_ms: float
    long_ratio: float
    probes: int
    probes_lost: int


def measure(profile_name: str, minutes: float) -> dict[str, Any]:
    """One run. Raises RuntimeError if the guest fails."""
    profile = load_profile(profile_name)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_temporary_key(folder)
        for side in _WAYS:
            (folder / f"{side}.toml").write_text(tomlkit.dumps(_config(side)))
        line = [sys.executable, "-m", "straitlink", "link", "--guest", "--profile", profile_name]
        line += ["--timeout", str(minutes * 60 + 150), "--linger", "60", "--"]
        sides = [
            [
                sys.executable,
                "-m",
                "bench.guest_link",
                f"--side={side}",
                f"--folder={name}",
                f"--minutes={minutes}",
            ]
            for side in _WAYS
        ]
        done = subprocess.run(
            [*line, *sides[0], ":::", *sides[1]],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=minutes * 60 + 240,
            check=False,
        )
        if done.returncode:
            raise RuntimeError(f"the guest ended with exit code {done.returncode}: {done.stderr[-2000:]}")
        seen = {side: json.loads((folder / f"{side}.json").read_text()) for side in _WAYS}
    return {
        "profile": profile_name,
        "minutes": minutes,
        "down": asdict(_judge(profile, "down", seen["robot"], seen["operator"])),
        "up": asdict(_judge(profile, "up", seen["operator"], seen["robot"])),
    }


def _config(side: str) -> dict[str, object]:
    other = "operator" if side == "robot" else "robot"
    topics = [t for t in load_named_or_file("backlogged").topics if t.direction == _WAYS[side]]
    return {
        "link": {
            "side": side,
            "listen": f"{_ADDRESSES[side]}:{_PORT}",
            "peer": f"{_ADDRESSES[other]}:{_PORT}",
            "keys": [KEY_FILE],
        },
        "zenoh": {"listen": [_BUS]},
        "topics": [{"key": t.key, "class": t.traffic_class.name} for t in topics if t.traffic_class],
    }


def _judge(profile: Profile, way: str, sender: dict[str, Any], receiver: dict[str, Any]) -> Direction:
    bands = (profile.down if way == "down" else profile.up).bands
    queues_ms = np.array([_queue_ns(delay_ns, bands) for delay_ns in receiver["delays_ns"]]) / 1e6
    begin_s, end_s = sender["begin_s"], sender["end_s"]
    return Direction(
        used=round(sender["sent_bytes"] * 8 / _carried_bits(bands, begin_s, end_s), 4),
        p50_ms=round(float(np.percentile(queues_ms, 50)), 1),
        p95_ms=round(float(np.percentile(queues_ms, 95)), 1),
        long_ratio=round(float(np.mean(queues_ms > 100)), 4),
        probes=len(queues_ms),
        probes_lost=sender["probes"] - len(queues_ms),
    )


def _queue_ns(delay_ns: int, bands: tuple[Band, ...]) -> float:
    own_ns = [b.one_way_delay_ns + _PROBE_WIRE_BITS * 1e9 / b.rate_bps for b in bands if b.rate_bps]
    return max(0.0, delay_ns - max((ns for ns in own_ns if ns <= delay_ns), default=min(own_ns)))


def _carried_bits(bands: tuple[Band, ...], begin_s: float, end_s: float) -> float:
    """What a cyclic schedule that began at 0 can carry between two times."""
    bits, at_s, index = 0.0, 0.0, 0
    while at_s < end_s:
        band = bands[index % len(bands)]
        ends_s = at_s + band.duration_ns / 1e9
        bits += band.rate_bps * max(0.0, min(ends_s, end_s) - max(at_s, begin_s))
        at_s, index = ends_s, index + 1
    return bits


# In the guest.


def one_side(side: str, folder: Path, seconds: float) -> None:
    """A shaper, its publishers and the probes, until the time is over."""
    came_s, trace = time.monotonic(), folder / f"{side}.jsonl"
    line = [sys.executable, "-m", "straitlink", "shaper", str(folder / f"{side}.toml"), "--trace", str(trace)]
    shaper = subprocess.Popen(line)
    stop, delays_ns = threading.Event(), []
    probes = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    probes.bind((_ADDRESSES[side], _PROBE_PORT))
    probes.settimeout(0.2)

    def listen() -> None:
        while not stop.is_set():
            try:
                data = probes.recv(64)
            except TimeoutError:
                continue
            delays_ns.append(time.monotonic_ns() - int.from_bytes(data[:8], "little"))

    threads = [threading.Thread(target=listen), threading.Thread(target=_flood, args=(side, trace, stop))]
    for thread in threads:
        thread.start()
    other = (_ADDRESSES["operator" if side == "robot" else "robot"], _PROBE_PORT)
    time.sleep(15)  # until both shapers are up, and have met
    begin_s, begin_bytes, sent = time.monotonic(), _interface_bytes(), 0
    delays_ns.clear()
    while time.monotonic() < begin_s + seconds:
        probes.sendto(time.monotonic_ns().to_bytes(8, "little") + bytes(_PROBE_BYTES - 8), other)
        sent += 1
        time.sleep(max(0.0, begin_s + sent * _PROBE_INTERVAL_S - time.monotonic()))
    end_s, end_bytes = time.monotonic(), _interface_bytes()
    time.sleep(3)
    stop.set()
    for thread in threads:
        thread.join()
    shaper.terminate()
    shaper.wait(20)
    seen = {
        "begin_s": begin_s - came_s,  # the schedule begins with the two sides
        "end_s": end_s - came_s,
        "sent_bytes": end_bytes - begin_bytes,
        "probes": sent,
        "delays_ns": delays_ns,
    }
    (folder / f"{side}.json").write_text(json.dumps(seen))


def _interface_bytes() -> int:
    """What has left this namespace so far, without Ethernet's headers as netem's rate counts them not."""
    total = 0
    for line in Path("/proc/self/net/dev").read_text().splitlines()[2:]:
        device, _, counters = line.partition(":")
        if device.strip() != "lo":
            fields = counters.split()  # Linux: eight of what came, then bytes and packets that left
            total += int(fields[8]) - 14 * int(fields[9])
    return total


def _flood(side: str, trace: Path, stop: threading.Event) -> None:
    while not (trace.exists() and trace.stat().st_size) and not stop.wait(0.1):
        pass
    session = open_bus(BusSettings(connect=[_BUS]))
    topics = [t for t in load_named_or_file("backlogged").topics if t.direction == _WAYS[side]]
    publishers = {t.key: session.declare_publisher(t.key) for t in topics}
    payloads = {t.key: np.random.default_rng(1).bytes(t.payload_bytes) for t in topics}
    number, began_s = 0, time.monotonic()
    while not stop.wait(max(0.0, began_s + number / 20 - time.monotonic())):  # 1.6 Mbit/s
        for key, publisher in publishers.items():
            publisher.put(payloads[key], attachment=Stamp(time.time_ns(), number).encode())
        number += 1
    session.close()


def main() -> None:
    """Measure, print, and keep the figures under out/bench/."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--profile", default="trials")
    parser.add_argument("--minutes", type=float, default=6.0)
    parser.add_argument("--side", choices=tuple(_WAYS), help=argparse.SUPPRESS)
    parser.add_argument("--folder", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.side:
        one_side(arguments.side, arguments.folder, arguments.minutes * 60)
        return
    document = {**provenance(), **measure(arguments.profile, arguments.minutes)}
    OUT.parent.mkdir(parents=True, exist_ok=True)
    OUT.write_text(json.dumps(document, indent=1))
    print(json.dumps({key: document[key] for key in ("profile", "minutes", "down", "up")}, indent=1))


if __name__ == "__main__":
    main()

"""What a shaper costs while a robot publishes: `python -m bench.ingest [--seconds 60] [--rate 4000]`.

Real processes: a bus, both shapers over loopback UDP (no emulator: the link itself is not measured), and
a publisher that puts the synthetic mission's sizes. CPU and memory are the robot's shaper's, of the whole
process with Zenoh's own threads, read from /proc.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

import tomlkit

from bench.machine import keep
from messages.attachment import Stamp
from shaper.bus import BusSettings, open_bus
from straitlink.demo.configs import Addresses, free_addresses
from straitlink.mission.load import LoadTopic, load_named_or_file

_TICKS = os.sysconf("SC_CLK_TCK")
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
_PLAN = "operator_like/plan"


@dataclass(frozen=True, slots=True)
class IngestFigures:
    """memory_mb: resident, at a quarter of the run and at its end. plans: sent and delivered reliably."""

    seconds: float
    messages_per_s: float
    megabytes_per_s: float
    cpu_of_a_core: float
    memory_mb: tuple[float, float]
    plans_sent: int
    plans_delivered: int


def measure(seconds: float, rate: float) -> IngestFigures:
    """Publish for a while and look at the robot's shaper."""
    load = load_named_or_file("full")
    topics = [t for t in load.topics if t.direction == "down"]
    scale = rate / sum(t.rate_hz for t in topics)
    addresses = free_addresses()
    with tempfile.TemporaryDirectory() as folder:
        processes = _start(Path(folder), addresses, topics)
        try:
            return _publish(processes[0].pid, addresses, topics, scale, seconds)
        finally:
            for process in processes:
                process.terminate()
            for process in processes:
                process.wait(10)


def _start(folder: Path, addresses: Addresses, topics: list[LoadTopic]) -> list[subprocess.Popen[bytes]]:
    a = addresses
    bands = [{"name": "fast", "rate_bps": 1_000_000, "one_way_delay_ms": 1}]
    rows = [
        {"key": t.key, "class": t.traffic_class.name, **({"max_hz": t.max_hz} if t.max_hz else {})}
        for t in topics
        if t.traffic_class is not None
    ]
    rows.append({"key": _PLAN, "class": "plan"})
    sides = {
        "robot": (a.robot_shaper, a.operator_shaper, a.robot_bus, rows),
        "operator": (a.operator_shaper, a.robot_shaper, a.operator_bus, [{"key": "none", "class": "state"}]),
    }
    processes = []
    for side, (listen, peer, bus, side_rows) in sides.items():
        document = {
            "link": {"side": side, "listen": listen, "peer": peer, "bands": bands, "open": True},
            "zenoh": {"listen": [bus]},
            "topics": side_rows,
        }
        path = folder / f"{side}.toml"
        path.write_text(tomlkit.dumps(document))
        processes.append(subprocess.Popen([sys.executable, "-m", "straitlink", "shaper", str(path)]))
    time.sleep(4)  # loaded machines start Python slowly
    return processes


def _publish(
    pid: int, addresses: Addresses, topics: list[LoadTopic], scale: float, seconds: float
) -> IngestFigures:
    robot = open_bus(BusSettings(connect=[addresses.robot_bus]))
    operator = open_bus(BusSettings(connect=[addresses.operator_bus]))
    delivered: Counter[str] = Counter()
    subscriber = operator.declare_subscriber("**", lambda sample: delivered.update([str(sample.key_expr)]))
    publishers = {t.key: robot.declare_publisher(t.key) for t in topics}
    plan = robot.declare_publisher(_PLAN)
    time.sleep(0.5)
    sources = sorted((0.0, t.payload_bytes, scale * t.rate_hz, t.key) for t in topics)
    next_s = {key: 0.0 for _, _, _, key in sources}
    payloads = {key: os.urandom(size) for _, size, _, key in sources}
    rates = {key: hz for _, _, hz, key in sources}
    sent = sent_bytes = plans = 0
    started_s, cpu_before, memory_early = time.monotonic(), _cpu_s(pid), 0.0
    while (elapsed_s := time.monotonic() - started_s) < seconds:
        for key, due_s in next_s.items():
            while due_s <= elapsed_s:
                stamp = Stamp(time.time_ns(), sent & 0xFFFF_FFFF).encode()
                publishers[key].put(payloads[key], attachment=stamp)
                sent += 1
                sent_bytes += len(payloads[key])
                due_s += 1 / rates[key]
            next_s[key] = due_s
        if plans < elapsed_s * 2:
            plan.put(plans.to_bytes(4, "little") * 50, attachment=Stamp(time.time_ns(), plans).encode())
            plans += 1
        if elapsed_s > seconds / 4 and not memory_early:
            memory_early = _memory_mb(pid)
        time.sleep(0.001)
    wall_s = time.monotonic() - started_s
    cpu = (_cpu_s(pid) - cpu_before) / wall_s
    memory_late = _memory_mb(pid)
    time.sleep(3)
    subscriber.undeclare()
    robot.close()
    operator.close()
    return IngestFigures(
        round(wall_s, 1),
        round(sent / wall_s),
        round(sent_bytes / wall_s / 1e6, 2),
        round(cpu, 3),
        (round(memory_early, 1), round(memory_late, 1)),
        plans,
        delivered[_PLAN],
    )


def _cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS


def _memory_mb(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * _PAGE_BYTES / 1e6


def main() -> None:
    """Measure one rate and print it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--rate", type=float, default=4000, help="messages per second")
    arguments = parser.parse_args()
    figures = measure(arguments.seconds, arguments.rate)
    keep("ingest", asdict(figures))
    for name, value in asdict(figures).items():
        print(f"{name:20} {value}")


if __name__ == "__main__":
    main()

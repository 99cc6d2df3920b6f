"""What the robot's shaper costs when all of the synthetic mission comes to it, 4,000 messages/s and 5 MB/s,
over the emulated Trials. `python -m bench.live_mission [--seconds 600]`.

The demonstration runs as a user runs it, with the example's rules and two more, as Zenoh brings a shaper
only what it has a rule for. This process only looks at the robot's shaper in /proc, once a second. CPU and
memory are the whole process's, with Zenoh's threads. What was delivered comes from the run's report.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from bench.machine import provenance
from straitlink.report import read_run, summarise

OUT = Path("out/bench/live_mission.json")
FOLDER = Path("out/bench/live_mission")
_TICKS = os.sysconf("SC_CLK_TCK")
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
_ROBOT_TOML = Path("out/bench/live_mission_robot.toml")
_MORE_RULES = """
[[topics]]
key = "robot/lidar/scan"
class = "perception"
max_hz = 0.1
compression = "zstd"

[[topics]]
key = "robot/**"
class = "state"
max_hz = 1
compression = "zstd"
"""
_PLANS = ("operator/footstep_plan", "operator/motion_plan")


@dataclass(frozen=True, slots=True)
class LiveFigures:
    """messages_per_s: that came to the robot's shaper. memory_mb: resident, at each tenth. plans: reliable
    messages offered and delivered.
    """

    seconds: float
    messages_per_s: float
    cpu_of_a_core: float
    memory_mb: list[float]
    heartbeats: str
    heartbeat_age_p95_ms: float | None
    plans: str
    link_used: float | None


def measure(seconds: float, profile: str) -> LiveFigures:
    """Run the demonstration and watch it. Raises RuntimeError when it fails."""
    _ROBOT_TOML.parent.mkdir(parents=True, exist_ok=True)
    _ROBOT_TOML.write_text(Path("examples/robot.toml").read_text() + _MORE_RULES)
    command = [sys.executable, "-m", "straitlink", "demo", "--seconds", str(seconds), "--profile", profile]
    command += ["--robot", str(_ROBOT_TOML), "--out", str(FOLDER)]
    demo = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    samples: list[tuple[float, float, float]] = []  # monotonic s, CPU s, memory MB
    deadline_s = time.monotonic() + seconds + 600
    try:
        while demo.poll() is None and time.monotonic() < deadline_s:
            pid = _shaper_of(demo.pid)
            if pid is not None and (sample := _sample(pid)) is not None:
                samples.append(sample)
            time.sleep(1)
    finally:
        demo.terminate()
        code = demo.wait(30)
    if code or len(samples) < 3:
        raise RuntimeError(f"the demonstration ended with exit code {code} after {len(samples)} samples")
    return _figures(samples)


def _figures(samples: list[tuple[float, float, float]]) -> LiveFigures:
    (began_s, cpu_began_s, _), (ended_s, cpu_ended_s, _) = samples[0], samples[-1]
    summary = summarise(read_run(FOLDER))
    by_topic = {t.topic: t for t in summary.topics}
    heartbeat = by_topic["robot/heartbeat"]
    plans = [by_topic[key] for key in _PLANS if key in by_topic]
    offered = sum(t.offered or 0 for t in summary.topics if t.direction == "down")
    down = next(d for d in summary.directions if d.direction == "down")
    delay = heartbeat.one_way_delay
    return LiveFigures(
        round(ended_s - began_s, 1),
        round(offered / summary.duration_s),
        round((cpu_ended_s - cpu_began_s) / (ended_s - began_s), 3),
        [round(samples[len(samples) * tenth // 10][2], 1) for tenth in range(1, 10)]
        + [round(samples[-1][2], 1)],
        f"{heartbeat.delivered}/{heartbeat.offered}",
        None if delay is None else round(delay.p95_ns / 1e6, 1),
        f"{sum(t.delivered or 0 for t in plans)}/{sum(t.offered or 0 for t in plans)}",
        down.utilisation,
    )


def _shaper_of(demo_pid: int) -> int | None:
    """The process that runs robot.toml, a child of the demonstration."""
    for entry in Path(f"/proc/{demo_pid}/task/{demo_pid}/children").read_text().split():
        try:
            arguments = Path(f"/proc/{entry}/cmdline").read_bytes().split(b"\0")
        except OSError:
            continue
        if b"shaper" in arguments and any(a.endswith(b"robot.toml") for a in arguments):
            return int(entry)
    return None


def _sample(pid: int) -> tuple[float, float, float] | None:
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except OSError:
        return None
    return time.monotonic(), (int(fields[11]) + int(fields[12])) / _TICKS, pages * _PAGE_BYTES / 1e6


def main() -> None:
    """Measure, print, and leave the figures in out/bench/live_mission.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=120)
    parser.add_argument("--profile", default="trials")
    parser.add_argument("--json", action="store_true")
    a = parser.parse_args()
    figures = measure(a.seconds, a.profile)
    document = {**provenance(), **asdict(figures)}
    OUT.parent.mkdir(parents=True, exist_ok=True)
    OUT.write_text(json.dumps(document, indent=1))
    if a.json:
        print(json.dumps(document, indent=1))
        return
    for name, value in asdict(figures).items():
        print(f"{name:22} {value}")


if __name__ == "__main__":
    main()

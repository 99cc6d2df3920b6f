"""What live shapers make of a link that they know nothing of: `python -m bench.live_link`.

    python -m bench.live_link [--profile trials] [--minutes 6] [--json]

Two shapers over the UDP emulator, both directions always backlogged, as the rows of bench.link_estimation
are in virtual time, by twice what the fastest band carries; the same judge replays what entered the link.
The processor's share is the robot's shaper's, the whole process with Zenoh's threads. The shapers run as
a service's do: without a trace, which would cost another 3 %. A machine that is shared charges us for what
its other users take of a core's speed, so that is gauged beside it.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from bench.link_score import Packet, Score, judge
from bench.machine import provenance
from bench.processor_speed import ProcessorSpeed
from bench.wire_rig import WireRig
from messages.attachment import Stamp
from netem_scripts.band import Profile
from netem_scripts.profiles import load_profile
from shaper.bus import open_bus
from straitlink.mission import LoadTopic, load_named_or_file

OUT = Path("out/bench/live_link.json")
_BARE_S = 10.0
_SIDES = {"down": "robot", "up": "operator"}


@dataclass(frozen=True, slots=True)
class LiveFigures:
    """utilisation by all bytes on the wire. cpu_by_rate: by what the link carries down (bit/s).

    wakeups_per_s: of all threads of the shaper. cpu_of_bare_wakeups: what a Python process takes here that
    wakes up as often, and does nothing. processor_speed: the mean of the run over its best
    (bench.processor_speed); cpu_at_best_speed: cpu_of_a_core times that.
    """

    profile: str
    minutes: float
    utilisation: float
    down_utilisation: float
    up_utilisation: float
    p50_ms: float
    p95_ms: float
    long_ratio: float
    tail_drops: int
    worst_window: float
    cpu_of_a_core: float
    processor_speed: float
    cpu_at_best_speed: float
    cpu_by_rate: dict[int, float]
    wakeups_per_s: int
    cpu_of_bare_wakeups: float


def measure(profile_name: str, minutes: float) -> LiveFigures:
    """One run. Raises TimeoutError if a process does not come up."""
    profile, load = load_profile(profile_name), load_named_or_file("backlogged")
    tables = {
        side: [
            {"key": t.key, "class": t.traffic_class.name}
            for t in load.topics
            if t.direction == way and t.traffic_class is not None
        ]
        for way, side in _SIDES.items()
    }
    with (
        tempfile.TemporaryDirectory() as folder,
        WireRig(Path(folder), profile_name, tables, traced=False) as rig,
    ):
        for name in ("robot-bus", "operator-bus", "robot", "operator", "link"):
            rig.start(name)
        stop = threading.Event()
        topics = [_enough(topic, profile) for topic in load.topics]
        threads = [threading.Thread(target=_publish, args=(rig, topic, stop)) for topic in topics]
        for thread in threads:
            thread.start()
        began = rig.wakeups("robot"), time.monotonic()
        with ProcessorSpeed() as speed:
            cpu = _watch(rig, minutes * 60)
        wakeups_per_s = (rig.wakeups("robot") - began[0]) / (time.monotonic() - began[1])
        bare = _bare_wakeups(wakeups_per_s)  # while the others go on
        stop.set()
        for thread in threads:
            thread.join()
        return _figures(rig, profile, minutes, cpu, speed.share_of_best, round(wakeups_per_s), bare)


def _enough(topic: LoadTopic, profile: Profile) -> LoadTopic:
    """The same topic at no more than twice what the link ever carries."""
    most_bps = max(band.rate_bps for way in (profile.down, profile.up) for band in way.bands)
    return replace(topic, rate_hz=min(topic.rate_hz, max(10.0, 2 * most_bps / (8 * topic.payload_bytes))))


def _publish(rig: WireRig, topic: LoadTopic, stop: threading.Event) -> None:
    payload = np.random.default_rng(1).bytes(topic.payload_bytes)
    session = open_bus(rig.bus(_SIDES[topic.direction]))
    publisher = session.declare_publisher(topic.key)
    number, began_s = 0, time.monotonic()
    while not stop.wait(max(0.0, began_s + number / topic.rate_hz - time.monotonic())):
        publisher.put(payload, attachment=Stamp(time.time_ns(), number).encode())
        number += 1
    session.close()


def _watch(rig: WireRig, seconds: float) -> list[tuple[int, float]]:
    """(monotonic ns, processor seconds) of the robot's shaper, once a second."""
    samples, ends_s = [], time.monotonic() + seconds
    while time.monotonic() < ends_s:
        samples.append((time.monotonic_ns(), rig.cpu_s("robot")))
        time.sleep(min(1.0, max(0.0, ends_s - time.monotonic())))
    return samples


def _bare_wakeups(rate_hz: float) -> float:
    """Share of a core that a process takes which wakes up so often."""
    code = (
        "import select, sys, time\n"
        "wait_s, began_s = float(sys.argv[1]), time.process_time()\n"
        "for _ in range(round(float(sys.argv[2]) / wait_s)): select.select([], [], [], wait_s)\n"
        "print(time.process_time() - began_s)\n"
    )
    command = [sys.executable, "-c", code, str(1 / rate_hz), str(_BARE_S)]
    return round(
        float(subprocess.run(command, check=True, capture_output=True, text=True).stdout) / _BARE_S, 4
    )


def _figures(
    rig: WireRig,
    profile: Profile,
    minutes: float,
    cpu: list[tuple[int, float]],
    processor_speed: float,
    wakeups_per_s: int,
    cpu_of_bare_wakeups: float,
) -> LiveFigures:
    records = rig.records("link")
    begin_ns = next(r["t_ns"] for r in records if r["event"] == "band")
    end_ns = min(records[-1]["t_ns"] - begin_ns, round(minutes * 60e9))
    packets: dict[str, list[Packet]] = {"down": [], "up": []}
    for r in records:
        if r["event"] == "packet":
            packets[r["direction"]].append((r["t_ns"] - begin_ns, r["wire_bytes"]))
    down = judge(profile.down, profile.up, packets["down"], end_ns)
    up = judge(profile.up, profile.down, packets["up"], end_ns)
    queue_ms = np.concatenate([down.queue_ns, up.queue_ns]) / 1e6
    rates = [(r["t_ns"], r["rate_bps"]) for r in records if r["event"] == "band" and r["direction"] == "down"]
    cpu_of_a_core = (cpu[-1][1] - cpu[0][1]) / ((cpu[-1][0] - cpu[0][0]) / 1e9)
    return LiveFigures(
        profile=profile.name,
        minutes=minutes,
        utilisation=round(_used(down, up), 4),
        down_utilisation=round(down.utilisation, 4),
        up_utilisation=round(up.utilisation, 4),
        p50_ms=round(float(np.percentile(queue_ms, 50)), 1),
        p95_ms=round(float(np.percentile(queue_ms, 95)), 1),
        long_ratio=round(float(np.mean(queue_ms > 100)), 4),
        tail_drops=down.tail_drops + up.tail_drops,
        worst_window=round(min(down.worst_window, up.worst_window), 3),
        cpu_of_a_core=round(cpu_of_a_core, 4),
        processor_speed=round(processor_speed, 3),
        cpu_at_best_speed=round(cpu_of_a_core * processor_speed, 4),
        cpu_by_rate=_cpu_by_rate(cpu, rates),
        wakeups_per_s=wakeups_per_s,
        cpu_of_bare_wakeups=cpu_of_bare_wakeups,
    )


def _used(*scores: Score) -> float:
    return sum(s.served_bits for s in scores) / sum(s.capacity_bits for s in scores)


def _cpu_by_rate(cpu: list[tuple[int, float]], rates: list[tuple[int, int]]) -> dict[int, float]:
    """Share of a core in the seconds that lie wholly in bands of a rate."""
    spent: dict[int, list[float]] = {}
    for (begin_ns, begin_s), (end_ns, end_s) in pairwise(cpu):
        within = {rate for at_ns, rate in rates if at_ns <= begin_ns}
        changed = any(begin_ns < at_ns <= end_ns for at_ns, _ in rates)
        if within and not changed:
            rate = [rate for at_ns, rate in rates if at_ns <= begin_ns][-1]
            spent.setdefault(rate, []).append((end_s - begin_s) / ((end_ns - begin_ns) / 1e9))
    return {rate: round(float(np.mean(shares)), 4) for rate, shares in sorted(spent.items())}


def main() -> None:
    """Measure, print, and keep the figures under out/bench/."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--profile", default="trials")
    parser.add_argument("--minutes", type=float, default=6.0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    load_before = os.getloadavg()[0]
    figures = measure(arguments.profile, arguments.minutes)
    document = {**provenance(), "load_before": load_before, **asdict(figures)}
    OUT.parent.mkdir(parents=True, exist_ok=True)
    OUT.write_text(json.dumps(document, indent=1))
    if arguments.json:
        print(json.dumps(document, indent=1))
        return
    for name, value in asdict(figures).items():
        print(f"{name:20} {value}")


if __name__ == "__main__":
    sys.exit(main())

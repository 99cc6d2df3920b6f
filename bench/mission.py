"""How long a 30-minute mission takes, and what the operator gets out of it: `python -m bench.mission`.

Virtual-time figures are exact and the same on every machine; wall times are this machine's.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path

from bench.machine import provenance
from netem_scripts.profiles import load_profile
from straitlink.mission import MissionSettings, load_named_or_file, run_mission

OUT = Path("out/bench/mission.json")


@dataclass(frozen=True, slots=True)
class MissionFigures:
    """One mission. cpu_s: process time, twice; identical: whether the two runs agree to the byte."""

    profile: str
    load: str
    minutes: float
    seed: int
    cpu_s: tuple[float, float]
    identical: bool
    messages_per_s: float
    datagrams: int
    heartbeat_delivered: str
    heartbeat_age_p95_ms: float
    images_delivered: str
    down_utilisation: float
    down_queue_p95_ms: float
    down_queue_max_settled_ms: float
    trace_sha256: str


def measure(profile: str, load: str, minutes: float, seed: int = 1) -> MissionFigures:
    """Run a mission twice."""
    settings = MissionSettings(load_profile(profile), load_named_or_file(load), round(minutes * 60e9), seed)
    results, seconds = [], []
    for _ in range(2):
        started_s = time.process_time()
        results.append(run_mission(settings))
        seconds.append(round(time.process_time() - started_s, 2))
    result = results[0]
    topics, down = result["topics"], result["link"]["down"]
    heartbeat = topics["robot/heartbeat"]
    image = next(row for name, row in topics.items() if "image" in name)
    return MissionFigures(
        profile=profile,
        load=load,
        minutes=minutes,
        seed=seed,
        cpu_s=(seconds[0], seconds[1]),
        identical=results[0] == results[1],
        messages_per_s=round(sum(row["offered"] for row in topics.values()) / (minutes * 60)),
        datagrams=sum(direction["datagrams"] for direction in result["link"].values()),
        heartbeat_delivered=f"{heartbeat['delivered']}/{heartbeat['offered']}",
        heartbeat_age_p95_ms=heartbeat["age_p95_ms"],
        images_delivered=f"{image['delivered']}/{image['offered']}",
        down_utilisation=down["utilisation"],
        down_queue_p95_ms=down["queue_delay_p95_ms"],
        down_queue_max_settled_ms=down["queue_delay_max_settled_ms"],
        trace_sha256=result["trace_sha256"],
    )


CASES = (
    ("trials", "light", 30.0),
    ("trials", "full", 30.0),
    ("trials", "camera-flood", 4.0),
    ("constant-100k-500ms", "camera-flood", 0.5),
    ("constant-1m-50ms", "camera-flood", 0.5),
)


def main() -> None:
    """Print a table, or JSON; either way leave the figures in out/bench/mission.json."""
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    figures = [measure(*case) for case in CASES]
    document = {**provenance(), "missions": [asdict(f) for f in figures]}
    OUT.parent.mkdir(parents=True, exist_ok=True)
    OUT.write_text(json.dumps(document, indent=1))
    if arguments.json:
        print(OUT.read_text())
        return
    table = Table(title="Missions in virtual time", title_justify="left", box=SIMPLE, padding=0)
    table.add_column("profile, load", no_wrap=True)
    for heading in (
        "min",
        "CPU s",
        "same",
        "msg/s",
        "heartbeats",
        "age p95 ms",
        "images",
        "link",
        "settled max ms",
    ):
        table.add_column(heading, justify="right", no_wrap=True)
    for f in figures:
        table.add_row(
            f"{f.profile}, {f.load}",
            f"{f.minutes:g}",
            f"{f.cpu_s[0]:.1f} {f.cpu_s[1]:.1f}",
            "yes" if f.identical else "NO",
            f"{f.messages_per_s:,.0f}",
            f.heartbeat_delivered,
            f"{f.heartbeat_age_p95_ms:.0f}",
            f.images_delivered,
            f"{f.down_utilisation:.1%}",
            f"{f.down_queue_max_settled_ms:.0f}",
        )
    console = Console()
    console.width = max(console.width, 130)
    console.print(table)


if __name__ == "__main__":
    main()

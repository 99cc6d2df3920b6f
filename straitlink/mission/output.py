"""A mission's result on the terminal and on disk."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from shaper.trace import TraceFile
from straitlink.mission.mission import MissionSettings, run_mission

_TRACES = ("robot", "operator", "link")


def run_and_save(
    settings: MissionSettings, out: Path | None, on_progress: Callable[[float], None] | None
) -> dict[str, Any]:
    """Run a mission; with a folder given, write its traces and run.json there for `straitlink report`."""
    if out is None:
        return run_mission(settings, None, on_progress)
    out.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        files = {}
        for name in _TRACES:
            path = out / f"{name}.jsonl"
            path.unlink(missing_ok=True)
            files[name] = TraceFile(path, line_buffered=False)
            stack.callback(files[name].close)
        result = run_mission(settings, lambda name, record: files[name].write(record), on_progress)
    run = {
        "kind": "mission",
        "profile": settings.profile.name,
        "source": settings.load.name,
        "seed": settings.seed,
        "duration_s": settings.duration_ns / 1e9,
        "start_ns": 0,
        **result,
    }
    (out / "run.json").write_text(json.dumps(run, indent=1))
    return result


def print_result(result: dict[str, Any], console: Console) -> None:
    """Two tables: what became of each topic, and how the link was used."""
    console.print(_topics_table(result["topics"]))
    console.print(_link_table(result["link"]))
    if "carousel" in result:
        row = result["carousel"]
        console.print(
            f"Carousel: {row['rate_bps'] / 1e6:,.1f} Mbit/s, {row['carousel_rounds']:,} rounds, "
            f"{row['carousel_datagrams']:,} datagrams: {row['carousel_received_datagrams']:,} arrived, "
            f"{row['carousel_repeated']:,} of them were there already\n"
        )
    if "wall_s" in result:
        console.print(f"{result['wall_s']:.1f} s of wall time; trace {result['trace_sha256'][:16]}")


def _topics_table(topics: dict[str, Any]) -> Table:
    counters = ["offered", "decimated", "delivered", "superseded", "expired", "overflow", "lost"]
    counters += [
        name
        for name in ("refused", "stale", "unreadable", "in_flight")
        if any(row[name] for row in topics.values())
    ]
    table = Table(title="Topics", title_justify="left", box=SIMPLE, padding=0, pad_edge=False)
    table.add_column("topic", no_wrap=True)
    for heading in (*counters, "age p50", "p95", "max ms", "kB"):
        table.add_column(heading, justify="right", no_wrap=True)
    for name, row in topics.items():
        ages = [row[f"age_{which}_ms"] for which in ("p50", "p95", "max")]
        table.add_row(
            f"{'↓' if row['direction'] == 'down' else '↑'} {name}",
            *(f"{row[counter]:,}" for counter in counters),
            *("-" if age is None else f"{age:.0f}" for age in ages),
            f"{row['bytes'] / 1000:,.1f}",
        )
    return table


def _link_table(link: dict[str, Any]) -> Table:
    table = Table(title="Link", title_justify="left", box=SIMPLE, padding=0, pad_edge=False)
    for heading in ("way", "used", "queue p50", "p95", "max", "max settled ms", "buffer drops", "lost"):
        table.add_column(heading, justify="right")
    for direction, row in link.items():
        delays = [row[f"queue_delay_{which}_ms"] for which in ("p50", "p95", "max", "max_settled")]
        table.add_row(
            direction,
            f"{row['utilisation']:.1%}",
            *("-" if delay is None else f"{delay:.0f}" for delay in delays),
            str(row["buffer_drops"]),
            str(row["lost_packets"]),
        )
    return table

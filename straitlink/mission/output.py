"""A mission's result on the terminal and on disk."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

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


def print_result(result: dict[str, Any]) -> None:
    """Two tables: what became of each topic, and how the link was used."""
    console = Console()
    counters = ("offered", "delivered", "superseded", "expired", "lost", "decimated", "overflow")
    ages = ("age_p50_ms", "age_p95_ms", "age_max_ms")
    table = Table(title="Topics", title_justify="left")
    table.add_column("topic")
    for heading in ("", *counters, "age p50 ms", "p95", "max", "kB"):
        table.add_column(heading, justify="right")
    for name, row in result["topics"].items():
        shown_ages = ["-" if row[age] is None else f"{row[age]:.0f}" for age in ages]
        counts = [str(row[counter]) for counter in counters]
        table.add_row(name, row["direction"], *counts, *shown_ages, f"{row['bytes'] / 1000:.1f}")
    console.print(table)
    table = Table(title="Link", title_justify="left")
    for heading in ("direction", "utilisation", "queue p50 ms", "p95", "max", "settled max", "buffer drops"):
        table.add_column(heading, justify="right")
    for direction, row in result["link"].items():
        delays = [f"{row[f'queue_delay_{name}_ms']:.0f}" for name in ("p50", "p95", "max", "max_settled")]
        table.add_row(direction, f"{row['utilisation']:.1%}", *delays, str(row["buffer_drops"]))
    console.print(table)
    if "wall_s" in result:
        console.print(f"{result['wall_s']:.1f} s of wall time; trace {result['trace_sha256'][:16]}")

"""The summary as tables in a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from .figures import count, percent, size, spread_cells
from .summary import Summary, TopicSummary

COUNTERS = ("offered", "decimated", "sent", "delivered", "superseded", "expired", "overflow", "lost")


def print_table(summary: Summary, console: Console | None = None) -> None:
    """Print counters and ages of the topics and, where the link was traced, its use."""
    console = console or Console()
    console.print(_counters(summary))
    console.print(_ages(summary))
    if summary.directions:
        console.print(_directions(summary))
    if summary.malformed_lines:
        console.print(f"{summary.malformed_lines} malformed trace line(s) passed over")


def _counters(summary: Summary) -> Table:
    """Counters that no trace tells of any topic are left out."""
    kept = [name for name in COUNTERS if any(getattr(row, name) is not None for row in summary.topics)]
    table = _topics(f"Messages over {summary.duration_s:.1f} s", (*kept, "payload"))
    for row in summary.topics:
        counters = (count(getattr(row, name)) for name in kept)
        table.add_row(_name(row), *counters, size(row.payload_bytes))
    return table


def _ages(summary: Summary) -> Table:
    table = _topics("Ages: p50, p95, max", ("one-way delay", "", "", "age of information", "", ""))
    for row in summary.topics:
        spreads = (*spread_cells(row.one_way_delay), *spread_cells(row.age_of_information))
        table.add_row(_name(row), *spreads)
    return table


def _name(row: TopicSummary) -> str:
    return f"{'↓' if row.direction == 'down' else '↑'} {row.topic}"


def _topics(title: str, columns: Sequence[str]) -> Table:
    table = Table(title=title, title_justify="left", box=SIMPLE, padding=0, pad_edge=False)
    table.add_column("topic", no_wrap=True)
    for name in columns:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def _directions(summary: Summary) -> Table:
    table = Table(title="Link", title_justify="left", box=SIMPLE, padding=0, pad_edge=False)
    table.add_column("way")
    for name in ("on the wire", "could carry", "used", "packets", "dropped"):
        table.add_column(name, justify="right")
    for name in ("queue p50", "p95", "max"):
        table.add_column(name, justify="right")
    for row in summary.directions:
        carried = size(row.wire_bytes), size(row.capacity_bytes or 0), percent(row.utilisation)
        packets = count(row.packets), count(row.dropped)
        table.add_row(row.direction, *carried, *packets, *spread_cells(row.queue_delay))
    return table

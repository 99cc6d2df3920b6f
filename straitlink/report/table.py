"""The summary as tables in a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from .figures import count, counters_told, percent, size, spread_cells
from .summary import Summary, TopicSummary


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
    kept = counters_told(summary)
    table = _topics(f"Messages over {summary.duration_s:.1f} s", (*kept, "payload"))
    for row in summary.topics:
        counters = (count(getattr(row, name)) for name in kept)
        table.add_row(_name(row), *counters, size(row.payload_bytes))
    return table


def _ages(summary: Summary) -> Table:
    heads = [
        f"{first}\n{second}\n{rank}"
        for name in ("one-way delay", "age at delivery", "age of information")
        for first, second, rank in ((*name.rsplit(" ", 1), "p50"), ("", "", "p95"), ("", "", "max"))
    ]
    table = _topics("Ages", heads)
    for row in summary.topics:
        spreads = (row.one_way_delay, row.age_at_delivery, row.age_of_information)
        table.add_row(_name(row), *(cell for spread in spreads for cell in spread_cells(spread)))
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
        carried = size(row.wire_bytes), size(row.capacity_bytes), percent(row.utilisation)
        packets = count(row.packets), count(row.dropped)
        table.add_row(row.direction, *carried, *packets, *spread_cells(row.queue_delay))
    return table

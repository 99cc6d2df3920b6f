"""The summary as tables in a terminal."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from .figures import count, percent, size, spread_cells
from .summary import Summary

COUNTERS = ("offered", "decimated", "sent", "delivered", "superseded", "expired", "overflow", "lost")


def print_table(summary: Summary, console: Console | None = None) -> None:
    """Print a table of topics and, where the link was traced, one of directions."""
    console = console or Console()
    console.print(_topics(summary))
    if summary.directions:
        console.print(_directions(summary))
    if summary.malformed_lines:
        console.print(f"{summary.malformed_lines} malformed trace line(s) passed over")


def _topics(summary: Summary) -> Table:
    table = Table(title=f"Topics over {summary.duration_s:.1f} s", title_justify="left")
    table.add_column("topic", no_wrap=True)
    table.add_column("way")
    for name in (*COUNTERS, "payload"):
        table.add_column(name, justify="right")
    for name in ("delay p50", "p95", "max", "age of inf. p50", "p95", "max"):
        table.add_column(name, justify="right", no_wrap=True)
    for row in summary.topics:
        counters = (count(getattr(row, name)) for name in COUNTERS)
        spreads = (*spread_cells(row.one_way_delay), *spread_cells(row.age_of_information))
        table.add_row(row.topic, row.direction, *counters, size(row.payload_bytes), *spreads)
    return table


def _directions(summary: Summary) -> Table:
    table = Table(title="Link", title_justify="left")
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

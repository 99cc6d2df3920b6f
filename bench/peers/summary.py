"""Medians and ranges over the seeds, and the table of them."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

SHOWN = {
    "camera-flood": {
        "heartbeat": "robot/heartbeat",
        "joints": "robot/joints",
        "images": "robot/image",
        "commands": "operator/command",
    },
    "full": {
        "heartbeat": "robot/heartbeat",
        "joints": "robot/joint_states",
        "images": "robot/head_camera/image",
        "commands": "operator/heartbeat",
    },
}
"""By load: what the tables show, and the topic that it is."""


@dataclass(frozen=True, slots=True)
class Spread:
    """Over the runs that have the figure; of how many there were."""

    median: float
    least: float
    most: float
    runs: int

    def text(self, form: str) -> str:
        """As "12 (10-15)", or "12" when all agree; a dash when no run has it."""
        if not self.runs:
            return "-"
        median, least, most = (format(v, form) for v in (self.median, self.least, self.most))
        return median if least == most else f"{median} ({least}-{most})"


@dataclass(frozen=True, slots=True)
class Row:
    """A stack in one band of a link under a load. topics: by the names of SHOWN, then by figure."""

    load: str
    profile: str
    window: str
    peer: str
    topics: dict[str, dict[str, Spread]]
    link: dict[str, Spread]


def spread(values: Iterable[float | None]) -> Spread:
    """None counts as not measured."""
    found = [v for v in values if v is not None]
    if not found:
        return Spread(0.0, 0.0, 0.0, 0)
    return Spread(statistics.median(found), min(found), max(found), len(found))


def summarise(results: Sequence[dict[str, Any]]) -> list[Row]:
    """In the order of the results: load, profile, window, stack."""
    groups: dict[tuple[str, str, str], dict[str, list[dict[str, Any]]]] = {}
    for result in results:
        for window in result["windows"]:
            place = (result["load"], result["profile"], window["name"])
            groups.setdefault(place, {}).setdefault(result["peer"], []).append(window)
    return [
        Row(*place, peer, _topics(place[0], windows), _link(windows))
        for place, peers in groups.items()
        for peer, windows in peers.items()
    ]


def _topics(load: str, windows: Sequence[dict[str, Any]]) -> dict[str, dict[str, Spread]]:
    figures = ("offered", "delivered", "in_window", "age_p50_ms", "age_p95_ms", "age_max_ms")
    return {
        name: {figure: spread(w["topics"][key][figure] for w in windows) for figure in figures}
        for name, key in SHOWN[load].items()
    }


def _link(windows: Sequence[dict[str, Any]]) -> dict[str, Spread]:
    links = [w["link"] for w in windows if w["link"] is not None]
    names = ("used", "queue_p50_ms", "queue_p95_ms", "queue_max_ms")
    return {name: spread(link[name] for link in links) for name in names}


def print_summary(rows: Sequence[Row]) -> None:
    """One table for each band of each link, the stacks as its lines."""
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    console = Console()
    if not console.is_terminal:
        console = Console(width=_PIPED_COLUMNS)
    for place in dict.fromkeys((r.load, r.profile, r.window) for r in rows):
        table = Table(title=" · ".join(place), box=SIMPLE, title_justify="left")
        for heading in COLUMNS:
            table.add_column(heading, justify="left" if heading == COLUMNS[0] else "right")
        for row in rows:
            if (row.load, row.profile, row.window) == place:
                table.add_row(*cells(row))
        console.print(table)


_PIPED_COLUMNS = 150
COLUMNS = (
    "stack", "heartbeat %", "age p50 ms", "p95 ms", "max ms", "joints %", "p95 ms", "images in time",
    "p50 ms", "commands %", "p95 ms", "link used %", "queue p95 ms",
)  # fmt: skip


def cells(row: Row) -> list[str]:
    """A line of the table: medians, with the range over the seeds where they differ."""
    heartbeat, joints, images, commands = (
        row.topics[n] for n in ("heartbeat", "joints", "images", "commands")
    )
    return [
        row.peer,
        _percent(heartbeat),
        heartbeat["age_p50_ms"].text(".0f"),
        heartbeat["age_p95_ms"].text(".0f"),
        heartbeat["age_max_ms"].text(".0f"),
        _percent(joints),
        joints["age_p95_ms"].text(".0f"),
        f"{images['in_window'].text('.0f')} of {images['offered'].text('.0f')}",
        images["age_p50_ms"].text(".0f"),
        _percent(commands),
        commands["age_p95_ms"].text(".0f"),
        f"{100 * row.link['used'].median:.0f}" if row.link["used"].runs else "-",
        row.link["queue_p95_ms"].text(".0f"),
    ]


def _percent(topic: dict[str, Spread]) -> str:
    """Delivered, however late, of what was offered."""
    offered = topic["offered"].median
    return f"{100 * topic['delivered'].median / offered:.0f}" if offered else "-"

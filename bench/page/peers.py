"""The section on other stacks, and where one of them is ahead."""

from __future__ import annotations

from bench.page.provenance import Document, command_text, counted, provenance_text
from bench.page.section import Bars, Curves, Section, Table
from bench.page.standing import FIGURES, OURS, behind
from bench.peers.summary import COLUMNS, Row, cells, summarise
from bench.peers.transport import PEERS


def peers(document: Document) -> Section:
    """Other stacks over the same link."""
    rows = summarise(document["runs"])
    tables, plots = [_standing(rows)], []
    for load, profile, window in dict.fromkeys((r.load, r.profile, r.window) for r in rows):
        here = [r for r in rows if (r.load, r.profile, r.window) == (load, profile, window)]
        caption = f"{load} over {profile}, band {window}"
        tables.append(Table(COLUMNS, [cells(r) for r in here], caption))
        if load == "camera-flood" and "100 kbit/s" in window:
            plots += _bars(caption, here)
    command = command_text(document, "make bench-peers")
    return Section(
        "Beside other stacks",
        _lead(document),
        "make bench-peers" if command == "python -m bench.peers" else command,
        provenance_text(document),
        tables,
        plots,
    )


def _lead(document: Document) -> str:
    runs = document["runs"]
    lead = (
        "Every stack carries the same messages through the same emulated link (`--tun`, network namespaces, "
        "unmodified programs), stamped and read by one clock. The link has 10 s of buffer. Medians over "
        f"{counted(len({r['seed'] for r in runs}), 'seed')}, the range in brackets. "
        "*In time*: delivered before the band ended. "
        f"TCP's congestion control is the host's, {document.get('tcp_congestion_control', 'unknown')}. "
        "Configurations: `bench/peers/config/`.\n\n" + "\n".join(f"- `{p.name}`: {p.summary}" for p in PEERS)
    )
    failed = [r for r in runs if "error" in r]
    if failed:
        lead += "\n\nRuns that could not be had: " + "; ".join(
            f"{r['peer']}, {r['profile']}, {r['load']}, seed {r['seed']} ({r['error']})" for r in failed
        )
    return lead


def _standing(rows: list[Row]) -> Table:
    """Each figure in which another stack is ahead; one line saying so if there is none."""
    compared = len(FIGURES) * sum(r.peer != OURS for r in rows)
    lines = [
        [b.place, b.figure, b.ours, b.theirs, b.peer, b.its_heartbeats, b.its_images] for b in behind(rows)
    ]
    return Table(
        ("where", "figure", "straitlink", "ahead of it", "stack", "its heartbeats", "its images in time"),
        lines or [["nowhere", "", "", "", "", "", ""]],
        f"Where another stack is ahead of straitlink, by more than 1 % of the messages or 3 % of an age: "
        f"{len(lines)} of {compared} comparisons (each figure of each band with each stack)",
    )


def _bars(caption: str, rows: list[Row]) -> list[Bars | Curves]:
    names = [r.peer for r in rows]
    ages = [r.topics["heartbeat"]["age_p95_ms"] for r in rows]
    images = [r.topics["images"]["in_window"] for r in rows]
    return [
        Bars(
            f"Heartbeat's age, p95: {caption}",
            names,
            [a.median if a.runs else None for a in ages],
            "ms",
            logarithmic=True,
            ranges=[(a.least, a.most) if a.runs else None for a in ages],
        ),
        Bars(
            f"Images in time: {caption}",
            names,
            [i.median for i in images],
            "images",
            ranges=[(i.least, i.most) for i in images],
        ),
    ]

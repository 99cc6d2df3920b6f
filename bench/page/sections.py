"""The parts of the page, each from the JSON that its bench leaves under out/bench."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from bench.page.section import Bars, Curves, Section, Table
from bench.peers.summary import COLUMNS, Row, cells, summarise
from bench.peers.transport import PEERS

Document = dict[str, Any]


def provenance_text(document: Document) -> str:
    """On what the figures were measured."""
    parts = [f"commit {document['commit']}"]
    if document.get("cpu"):
        parts.append(f"{document['cores']} cores of {document['cpu']}")
    parts.append(f"Python {document['python']}")
    return ", ".join(parts)


def peers(document: Document) -> Section:
    """Other stacks over the same link."""
    rows = summarise(document["runs"])
    tables, plots = [], []
    for load, profile, window in dict.fromkeys((r.load, r.profile, r.window) for r in rows):
        here = [r for r in rows if (r.load, r.profile, r.window) == (load, profile, window)]
        caption = f"{load} over {profile}, band {window}"
        tables.append(Table(COLUMNS, [cells(r) for r in here], caption))
        if load == "camera-flood" and "100 kbit/s" in window:
            plots += _peer_bars(caption, here)
    lead = (
        "Every stack carries the same messages through the same emulated link (`--tun`, network namespaces, "
        "unmodified programs), stamped and read by one clock. The link has 10 s of buffer. Medians over "
        f"{len({r['seed'] for r in document['runs']})} seeds, the range in brackets. "
        "*In time*: delivered before the band ended. "
        f"TCP's congestion control is the host's, {document.get('tcp_congestion_control', 'unknown')}. "
        "Configurations: `bench/peers/config/`.\n\n" + "\n".join(f"- `{p.name}`: {p.summary}" for p in PEERS)
    )
    failed = [r for r in document["runs"] if "error" in r]
    if failed:
        lead += "\n\nRuns that could not be had: " + "; ".join(
            f"{r['peer']}, {r['profile']}, {r['load']}, seed {r['seed']} ({r['error']})" for r in failed
        )
    return Section("Beside other stacks", lead, "make bench-peers", provenance_text(document), tables, plots)


def _peer_bars(caption: str, rows: list[Row]) -> list[Bars | Curves]:
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


def mission(document: Document) -> Section:
    """Virtual missions."""
    rows = [
        [
            f"{m['profile']}, {m['load']}, {m['minutes']:g} min",
            f"{min(m['cpu_s']):.1f}",
            str(m["messages_per_s"]),
            m["heartbeat_delivered"],
            f"{m['heartbeat_age_p95_ms']:.0f}",
            m["images_delivered"],
            f"{m['down_utilisation']:.1%}",
            f"{m['down_queue_p95_ms']:.0f}",
        ]
        for m in document["missions"]
    ]
    header = (
        "mission", "CPU s", "messages/s", "heartbeats", "age p95 ms", "images", "link used", "queue p95 ms",
    )  # fmt: skip
    return Section(
        "Missions in virtual time",
        "Both shapers and the link in one process; all but the CPU time is exact, the same on any machine.",
        "python -m bench.mission",
        provenance_text(document),
        [Table(header, rows)],
    )


def scale(document: Document) -> Section:
    """Cost curves."""
    tables, lines = [], {}
    for curve in document["curves"]:
        quantity = curve["quantity"]
        sizes = [p["case"][quantity] for p in curve["points"]]
        rows = [
            [
                str(size),
                f"{p['cpu_of_a_core']:.4f}",
                f"{p['cpu_us_per_message']:.1f}",
                f"{p['memory_mb']:.0f}",
                f"{p['delivered_per_s']:.0f}",
            ]
            for size, p in zip(sizes, curve["points"], strict=True)
        ]
        cpu, memory = curve["cpu_exponent"], curve["memory_exponent"]
        caption = f"{quantity}: exponent of CPU {cpu:.2f}, of memory {memory:.2f}"
        header = (quantity, "of a core", "us per message", "MB", "delivered/s")
        tables.append(Table(header, rows, caption))
        lines[quantity] = (sizes, [p["cpu_of_a_core"] for p in curve["points"]])
    return Section(
        "How the cost grows",
        "CPU of both ends at 1 Mbit/s in virtual time; an exponent of 1 is linear. Offers that are replaced "
        "before they leave cost little, so the cost follows what the link carries.",
        "python -m bench.scale",
        provenance_text(document),
        tables,
        [Curves("CPU", "topics, messages/s or links", "of a core", lines)],
    )


def soak(document: Document) -> Section:
    """A day."""
    hours = document["hours"]
    shown = [hours[i] for i in sorted({0, 1, len(hours) // 4, len(hours) // 2, len(hours) - 1})]
    rows = [
        [
            str(h["hour"]),
            f"{h['memory_mb']:.1f}",
            str(h["objects"]),
            str(h["offered"]),
            str(h["delivered"]),
            str(h["datagrams"]),
        ]
        for h in shown
    ]
    faults = "none" if not document["faults"] else "; ".join(document["faults"][:5])
    return Section(
        "A day",
        f"{len(hours)} virtual hours of the Trials' link in {document['cpu_s']:.0f} s of CPU. Memory grew by "
        f"{document['growth_mb']} MB after the second hour. Faults: {faults}.",
        "python -m bench.soak",
        provenance_text(document),
        [Table(("hour", "MB", "objects", "offered", "delivered", "datagrams"), rows)],
    )


def codec(document: Document) -> Section:
    """Message codec."""
    rows = [
        [
            f"{c['message']}, {c['way']}",
            str(c["dccl_bytes"]),
            str(c["protobuf_bytes"]),
            f"{c['encodes_per_s']:,}",
            f"{c['encode_factor']:.1f}",
            f"{c['decodes_per_s']:,}",
            f"{c['decode_factor']:.1f}",
        ]
        for c in document["codec"]
    ]
    header = ("message", "DCCL B", "protobuf B", "encodes/s", "x C++", "decodes/s", "x C++")
    return Section(
        "Messages",
        "One core; the factor is over the C++ DCCL 4.2.0 library's own speed on the same message.",
        "python -m bench.codec",
        provenance_text(document),
        [Table(header, rows)],
    )


def live_mission(document: Document) -> Section:
    """The demonstration's robot-side shaper."""
    memory = document["memory_mb"]
    rows = [
        ["CPU of the robot's shaper, of a core", f"{document['cpu_of_a_core']:.2f}"],
        ["resident memory, after a tenth and at the end, MB", f"{memory[0]:.1f}, {memory[-1]:.1f}"],
        ["heartbeats", document["heartbeats"]],
        ["reliable plans", document["plans"]],
    ]
    return Section(
        "The demonstration, live",
        f"{document['seconds']:.0f} s of the synthetic mission (4,000 messages/s, 5 MB/s) over the Trials.",
        "python -m bench.live_mission --seconds 600",
        provenance_text(document),
        [Table(("figure", "value"), rows)],
    )


def link_estimation(document: Document) -> Section:
    """What each estimator makes of each kind of link."""
    tables = []
    for estimator in dict.fromkeys(r["estimator"] for r in document["rows"]):
        rows = []
        for r in (r for r in document["rows"] if r["estimator"] == estimator):
            worst = r["worst"]
            rows.append(
                [
                    r["row"],
                    _number(worst["utilisation"], ".1%"),
                    _number(worst["p50_ms"], ".0f"),
                    _number(worst["p95_ms"], ".0f"),
                    _number(worst["long_ratio"], ".1%"),
                    _number(worst["down_s"], ".2f"),
                    _number(worst["up_s"], ".2f"),
                    _number(worst["back_s"], ".2f"),
                    _number(worst["payload_ratio"], ".1%"),
                    ", ".join(r["misses"]) or "none",
                ]
            )
        header = (
            "link", "used", "queue p50 ms", "p95 ms", "> 100 ms", "fall s", "rise s", "back s", "payload",
            "misses",
        )  # fmt: skip
        tables.append(Table(header, rows, estimator))
    return Section(
        "What the shaper makes of a link",
        f"An always backlogged mission of {document['minutes']:g} virtual minutes on each link, the worst of "
        "the seeds. *Used*: of the true rate, by all bytes sent. *Fall*, *rise*: seconds until the rate "
        "is right after a change. *Back*: after a blackout. *Misses*: figures outside what the row asks for.",
        "python -m bench.link_estimation",
        provenance_text(document),
        tables,
    )


def _number(value: float | None, form: str) -> str:
    """NaN and infinity are "never" and "none" of a kind: a dash."""
    return "-" if value is None or not math.isfinite(value) else format(value, form)


def view_codec(document: Document) -> Section:
    """Views, clouds and pictures."""
    rows = [
        [
            f"{r['product']}: {r['codec']}",
            str(r["views"]),
            f"{r['bytes']:,.0f}",
            f"{r['ratio']:.2f}",
            f"{r['encode_ms']:.1f}",
            f"{r['decode_ms']:.1f}",
            "" if r["paper_bytes"] is None else f"{r['paper_bytes']:,}",
        ]
        for r in document["rows"]
    ]
    header = ("view", "of", "bytes", "ratio", "encode ms", "decode ms", "Table 1 of the paper, B")
    return Section(
        "Views",
        "Mean bytes; the ratio is to the paper's encoding at the same fidelity; CPU of one core, medians.",
        "python -m bench.view_codec",
        provenance_text(document),
        [Table(header, rows)],
    )


def delta(document: Document) -> Section:
    """State streams against acknowledged messages."""
    rows = [
        [
            f"{d['motion']}, {d['form']}",
            "none" if d["reference_s"] is None else f"{d['reference_s']:g} s old",
            f"{d['loss_ratio']:.0%}",
            f"{d['mean_bytes']:.1f}",
            str(d["max_bytes"]),
            f"{d['encodes_per_s']:,}",
            f"{d['decodes_per_s']:,}",
        ]
        for d in document["delta"]
    ]
    header = ("28 joints and pose", "reference", "loss", "mean B", "max B", "encodes/s", "decodes/s")
    return Section(
        "A robot's state",
        "At 10 Hz, each message alone and as a difference against one that has arrived.",
        "python -m bench.delta",
        provenance_text(document),
        [Table(header, rows)],
    )


SECTIONS: dict[str, Callable[[Document], Section]] = {
    "peers": peers,
    "link_estimation": link_estimation,
    "mission": mission,
    "live_mission": live_mission,
    "scale": scale,
    "soak": soak,
    "view_codec": view_codec,
    "codec": codec,
    "delta": delta,
}
"""By the name of the JSON file, in the order of the page."""

"""Sections on what the shaper costs and how long it lasts."""

from __future__ import annotations

from collections.abc import Sequence

from bench.page.provenance import Document, command_text, provenance_text
from bench.page.section import Curves, Section, Table


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
        command_text(document, "python -m bench.mission"),
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
        "The synthetic mission, live",
        f"{document['seconds']:.0f} s of the demonstration (5 MB/s) over the Trials, with rules for "
        f"all topics of the mission: {document['messages_per_s']:,} messages/s come to the robot's shaper.",
        command_text(document, f"python -m bench.live_mission --seconds {document['seconds']:.0f}"),
        provenance_text(document),
        [Table(("figure", "value"), rows)],
    )


def scale(document: Document) -> Section:
    """Cost curves."""
    tables: list[Table] = []
    lines: dict[str, tuple[Sequence[float], Sequence[float]]] = {}
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
        "before they leave cost little, so the cost follows what the link carries. *Seconds*: how long it "
        "has run, where 0 is right. *Backlog*: reliable messages that one topic may hold, with more offered "
        "than the link carries.",
        command_text(document, "python -m bench.scale"),
        provenance_text(document),
        tables,
        [Curves("CPU", "topics, messages/s, links, seconds or backlog", "of a core", lines)],
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
        command_text(document, "python -m bench.soak"),
        provenance_text(document),
        [Table(("hour", "MB", "objects", "offered", "delivered", "datagrams"), rows)],
    )


def ingest(document: Document) -> Section:
    """A robot's bus at full rate."""
    rows = [
        ["messages per second", f"{document['messages_per_s']:,.0f}"],
        ["MB per second", f"{document['megabytes_per_s']:.1f}"],
        ["CPU of the robot's shaper, of a core", f"{document['cpu_of_a_core']:.2f}"],
        [
            "resident memory, at a quarter and at the end, MB",
            ", ".join(f"{m:.1f}" for m in document["memory_mb"]),
        ],
        ["reliable plans delivered", f"{document['plans_delivered']} of {document['plans_sent']}"],
    ]
    return Section(
        "A robot's bus",
        f"{document['seconds']:.0f} s of messages of the synthetic mission's sizes through real processes, "
        "the shapers joined by loopback: what looking at every message costs, Zenoh's own threads included.",
        command_text(document, f"python -m bench.ingest --seconds {document['seconds']:g}"),
        provenance_text(document),
        [Table(("figure", "value"), rows)],
    )

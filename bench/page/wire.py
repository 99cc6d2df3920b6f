"""Sections on what is done to the shaper: kill -9 and a stranger's flood."""

from __future__ import annotations

from bench.page.provenance import Document, command_text, provenance_text
from bench.page.section import Section, Table

_COUNTS = {
    "kills": "kills, of both sides in turn",
    "published": "commands published, both ways",
    "arrived": "arrived",
    "doubled": "arrived twice",
    "lost_without_a_word": "lost without a word to their publisher",
    "never_accepted": "put while no shaper was there to take them",
    "corrupt_journals": "journals that cannot be read afterwards",
}


def wire_kill(document: Document) -> Section:
    """Processes killed outright."""
    counts = [[text, str(document[name])] for name, text in _COUNTS.items() if name in document]
    times = [
        [name.removesuffix(" p50, max"), *(f"{1000 * seconds:.0f}" for seconds in pair)]
        for name, pair in document.items()
        if name.endswith(" p50, max")
    ]
    return Section(
        "Killed with -9",
        "Commands of 10 Hz each way over 1 Mbit/s while each shaper is killed at random moments and started "
        "anew. *Process*: until it has its port and its bus; *handshake*, *channel* and *resume* count from "
        "there until the peer is proved, a message has crossed each way, and the same with the wait for one "
        "to be published.",
        command_text(document, "python -m bench.wire_kill"),
        provenance_text(document),
        [Table(("messages", "number"), counts), Table(("after a kill, ms", "p50", "most"), times)],
    )


def wire_flood(document: Document) -> Section:
    """Datagrams that nobody asked for."""
    what = {
        "random": "random datagrams",
        "initiations": "forged initiations of the handshake that name the link's key",
    }[document["kind"]]
    rows = [
        ["datagrams per second that were sent", f"{document['datagrams_per_s']:,}"],
        ["heartbeats, calm and flooded", f"{document['heartbeats_calm']}, {document['heartbeats_flooded']}"],
        ["heartbeat's age p95, calm, ms", f"{1000 * document['age_p95_calm_s']:.1f}"],
        ["heartbeat's age p95, flooded, ms", f"{1000 * document['age_p95_flooded_s']:.1f}"],
        ["the shaper's CPU meanwhile, of a core", f"{document['cpu_of_a_core']:.2f}"],
    ]
    flag = " --initiations" if document["kind"] == "initiations" else ""
    return Section(
        f"A stranger's flood: {what}",
        f"Ages of a 20 Hz heartbeat without and with {what} sent to the receiving shaper's port. The flood's "
        "own sending takes a core of the same machine.",
        command_text(document, f"python -m bench.wire_flood{flag}"),
        provenance_text(document),
        [Table(("figure", "value"), rows)],
    )

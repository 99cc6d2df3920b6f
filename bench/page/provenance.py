"""On what the figures of a section were measured, in one line."""

from __future__ import annotations

from typing import Any

Document = dict[str, Any]
"""What a bench leaves under out/bench."""


def provenance_text(document: Document) -> str:
    """Commit, machine, and how busy it was."""
    parts = [f"commit {document['commit']}"]
    if document.get("when"):
        parts.append(str(document["when"]).replace("T", " ").replace("+00:00", " UTC"))
    if document.get("cpu"):
        parts.append(f"{document['cores']} cores of {document['cpu']}")
    if document.get("load_average"):
        parts.append(f"load average at the end {document['load_average'][0]:.1f}")
    parts.append(f"Python {document['python']}")
    return ", ".join(parts)


def command_text(document: Document, usual: str) -> str:
    """What reproduces it: what was typed, without what only says how to print."""
    return str(document.get("command", usual)).removesuffix(" --json")


def counted(number: int, noun: str) -> str:
    """As "3 seeds" or "1 seed"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def number(value: float | None, form: str) -> str:
    """NaN and infinity are "never" and "none" of a kind: a dash."""
    return "-" if value is None or value != value or value in (INFINITY, -INFINITY) else format(value, form)


INFINITY = float("inf")

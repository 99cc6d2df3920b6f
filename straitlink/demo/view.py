"""What is going on, while it goes on: a table from the tails of the two shapers' traces."""

from __future__ import annotations

import json
from collections import deque
from pathlib import Path
from typing import Any

from rich import box
from rich.table import Table

_RECENT_NS = 5_000_000_000  # ages and rates are of this long


class TraceTail:
    """Follows a trace that is being written: the newest ledger and link state, recent deliveries."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._read_bytes = 0
        self.topics: dict[str, dict[str, Any]] = {}
        self.link_state: dict[str, Any] = {}
        self._delivered: deque[tuple[int, str, int]] = deque()  # t_ns, topic, age_ns
        self._sent: deque[tuple[int, int]] = deque()  # t_ns, wire_bytes
        self._now_ns = 0

    def follow(self) -> None:
        """Read what has been added since the last time; a line that is still being written waits."""
        if not self._path.exists():
            return
        with self._path.open("rb") as file:
            file.seek(self._read_bytes)
            for line in file:
                if not line.endswith(b"\n"):
                    break
                self._read_bytes += len(line)
                self._take(json.loads(line))
        for recent in (self._delivered, self._sent):
            while recent and recent[0][0] < self._now_ns - _RECENT_NS:
                recent.popleft()

    def recent_age_ms(self, topic: str) -> float | None:
        """The worst age at delivery in the last five seconds."""
        ages = [age_ns for _, name, age_ns in self._delivered if name == topic]
        return max(ages) / 1e6 if ages else None

    def recent_kbps(self) -> float:
        """What this side has put on the wire in the last five seconds, headers included."""
        return sum(wire_bytes for _, wire_bytes in self._sent) * 8 / (_RECENT_NS / 1e9) / 1e3

    def _take(self, record: dict[str, Any]) -> None:
        self._now_ns = max(self._now_ns, record["t_ns"])
        match record["event"]:
            case "delivered":
                self._delivered.append((record["t_ns"], record["topic"], record["age_ns"] or 0))
            case "sent":
                self._sent.append((record["t_ns"], record["wire_bytes"]))
            case "ledger":
                self.topics = record["topics"]
            case "link_state":
                self.link_state = record


class LiveView:
    """Both ends at a glance."""

    def __init__(self, folder: Path, duration_s: float) -> None:
        self._tails = {"down": TraceTail(folder / "robot.jsonl"), "up": TraceTail(folder / "operator.jsonl")}
        self._duration_s = duration_s

    def follow(self) -> None:
        """Read both traces on."""
        for tail in self._tails.values():
            tail.follow()

    def table(self, elapsed_s: float) -> Table:
        """The state of things, for a terminal of 80 columns."""
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False, title_justify="left", title=self._title(elapsed_s))
        table.add_column("topic", no_wrap=True)
        for heading in ("offered", "sent", "delivered", "lost", "age ms"):
            table.add_column(heading, justify="right")
        for sends, receiver in (("down", "up"), ("up", "down")):
            received = self._tails[receiver]
            for key, sent in self._tails[sends].topics.items():
                if sent["direction"] != sends:
                    continue
                got = received.topics.get(key, {})
                age_ms = received.recent_age_ms(key)
                table.add_row(
                    ("↓ " if sends == "down" else "↑ ") + key,
                    *(str(row.get(name, 0)) for row, name in _cells(sent, got)),
                    "-" if age_ms is None else f"{age_ms:.0f}",
                )
        return table

    def line(self, elapsed_s: float) -> str:
        """The same in one line, where there is no terminal."""
        delivered = sum(
            row.get("delivered", 0) for tail in self._tails.values() for row in tail.topics.values()
        )
        return f"{self._title(elapsed_s)}, {delivered} messages delivered"

    def _title(self, elapsed_s: float) -> str:
        parts = [f"{elapsed_s:.0f} of {self._duration_s:.0f} s"]
        for sends, tail in self._tails.items():
            band = tail.link_state.get("band", "no link yet")
            parts.append(f"{sends}: {band}, {tail.recent_kbps():.0f} kbit/s")
        return "  |  ".join(parts)


def _cells(sent: dict[str, Any], got: dict[str, Any]) -> list[tuple[dict[str, Any], str]]:
    return [(sent, "offered"), (sent, "sent"), (got, "delivered"), (got, "lost")]

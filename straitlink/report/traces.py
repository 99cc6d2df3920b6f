"""Reads a run folder's JSON lines and puts robot, operator and link on one time line."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

Rows = dict[str, list[tuple[int, ...]]]
Event = dict[str, Any]

UNKNOWN_NS = -(2**63)  # a delay that the receiver could not tell yet (null in the trace)
_SENDS = {"robot": "down", "operator": "up"}  # the direction that a side sends into
_RECEIVES = {"robot": "up", "operator": "down"}
_COUNTED_BY_SENDER = ("offered", "decimated", "superseded", "expired", "overflow", "sent", "sent_bytes")
_COUNTED_BY_RECEIVER = ("delivered", "lost", "received_bytes")
_MALFORMED = (ValueError, KeyError, TypeError, AttributeError)


@dataclass(slots=True)
class Traces:
    """The events of a run folder, times in nanoseconds from the start of the run, rows by topic or direction.

    delivered: (t, age, one-way delay, payload bytes). departures: (t, wire bytes). estimates and
    bands: (t, rate in bit/s). packets: (t, wire bytes, queue delay, dropped 0 | 1).
    """

    facts: Event = field(default_factory=dict)
    found: list[str] = field(default_factory=list)
    duration_ns: int = 1
    topics: dict[str, str] = field(default_factory=dict)
    ledgers: dict[str, dict[str, int]] = field(default_factory=dict)
    delivered: Rows = field(default_factory=lambda: defaultdict(list))
    departures: Rows = field(default_factory=lambda: defaultdict(list))
    estimates: Rows = field(default_factory=lambda: defaultdict(list))
    packets: Rows = field(default_factory=lambda: defaultdict(list))
    bands: Rows = field(default_factory=lambda: defaultdict(list))
    malformed_lines: int = 0

    def shift(self, origin_ns: int) -> None:
        """Count time from origin_ns."""
        for rows in (self.delivered, self.departures, self.estimates, self.packets, self.bands):
            for key, events in rows.items():
                rows[key] = [(event[0] - origin_ns, *event[1:]) for event in events]

    def last_ns(self) -> int:
        """Time of the last event."""
        all_rows = (self.delivered, self.departures, self.estimates, self.packets, self.bands)
        return max((event[0] for rows in all_rows for events in rows.values() for event in events), default=0)


def read_traces(folder: Path) -> Traces:
    """All that the folder has. Lines that are not JSON, or lack a field, are counted and passed over."""
    traces = Traces()
    if (folder / "run.json").exists():
        traces.facts = json.loads((folder / "run.json").read_text())
    begins: dict[str, tuple[int, int]] = {}  # file -> (t_ns, unix_ns) of its first start line
    for name in ("robot", "operator", "link"):
        path = folder / f"{name}.jsonl"
        if path.exists():
            traces.found.append(name)
            begin = _TraceFile(traces, name).read(path)
            if begin is not None:
                begins[name] = begin
    origin_ns = _origin_ns(traces.facts, begins)
    traces.shift(origin_ns)
    traces.facts.setdefault("start_unix_ns", origin_ns)
    duration_s = traces.facts.get("duration_s")
    traces.duration_ns = max(round(duration_s * 1e9) if duration_s else traces.last_ns(), 1)
    return traces


def _origin_ns(facts: Event, begins: dict[str, tuple[int, int]]) -> int:
    """The start of the run in unix time: run.json's start_ns by the link's clock, else the first start line.

    start_ns is believed only where it is near the link's own start line: a live run has none.
    """
    first_ns = min((unix_ns for _, unix_ns in begins.values()), default=0)
    start_ns = facts.get("start_ns")
    if isinstance(start_ns, int) and "link" in begins:
        t_ns, unix_ns = begins["link"]
        if abs(start_ns - t_ns) < 600_000_000_000:
            return unix_ns + start_ns - t_ns
    return first_ns


class _TraceFile:
    """One file's events, on unix time; a "start" line in its midst is a process that began again."""

    def __init__(self, traces: Traces, name: str) -> None:
        self.traces = traces
        self.side = name
        self.unix_from_t_ns = 0
        self.begin: tuple[int, int] | None = None
        self.ledger: Event = {}
        self.take: dict[str, Callable[[Event, int], None]] = {
            "delivered": self._delivered,
            "sent": self._sent,
            "link_state": self._link_state,
            "ledger": self._ledger,
            "packet": self._packet,
            "band": self._band,
        }

    def read(self, path: Path) -> tuple[int, int] | None:
        with path.open(encoding="utf-8", errors="replace") as lines:
            for line in lines:
                try:
                    self._event(json.loads(line))
                except _MALFORMED:
                    self.traces.malformed_lines += 1
        self._bank_ledger()
        return self.begin

    def _event(self, event: Event) -> None:
        if event["event"] == "start":
            self._start(event)
        elif event["event"] in self.take:
            self.take[event["event"]](event, event["t_ns"] + self.unix_from_t_ns)

    def _start(self, event: Event) -> None:
        self._bank_ledger()
        self.side = event["side"]
        self.unix_from_t_ns = event["unix_ns"] - event["t_ns"]
        if self.begin is None:
            self.begin = (event["t_ns"], event["unix_ns"])

    def _delivered(self, event: Event, t_ns: int) -> None:
        age_ns, delay_ns = (
            UNKNOWN_NS if event[name] is None else event[name] for name in ("age_ns", "one_way_delay_ns")
        )
        row = (t_ns, age_ns, delay_ns, event["payload_bytes"])
        if not all(isinstance(value, int) for value in row):
            raise TypeError(f"delivered: {row} must be integers")
        self.traces.topics.setdefault(event["topic"], _RECEIVES[self.side])
        self.traces.delivered[event["topic"]].append(row)

    def _sent(self, event: Event, t_ns: int) -> None:
        self.traces.departures[_SENDS[self.side]].append((t_ns, int(event["wire_bytes"])))

    def _link_state(self, event: Event, t_ns: int) -> None:
        self.traces.estimates[_SENDS[self.side]].append((t_ns, int(event["rate_bps"])))

    def _ledger(self, event: Event, t_ns: int) -> None:
        self.ledger = event["topics"]

    def _packet(self, event: Event, t_ns: int) -> None:
        dropped = event["dropped"] is not None
        row = (t_ns, int(event["wire_bytes"]), int(event["queue_delay_ns"] or 0), int(dropped))
        self.traces.packets[event["direction"]].append(row)

    def _band(self, event: Event, t_ns: int) -> None:
        self.traces.bands[event["direction"]].append((t_ns, int(event["rate_bps"])))

    def _bank_ledger(self) -> None:
        """Add this process's last counters: a restarted one counts from zero again."""
        for topic, counters in self.ledger.items():
            direction = counters["direction"]
            self.traces.topics[topic] = direction
            sends = _SENDS.get(self.side) == direction
            row = self.traces.ledgers.setdefault(topic, {})
            for name in _COUNTED_BY_SENDER if sends else _COUNTED_BY_RECEIVER:
                if counters.get(name) is not None:
                    row[name] = row.get(name, 0) + int(counters[name])
            if not sends and counters.get("expired"):  # the receiver's age gate
                row["expired"] = row.get("expired", 0) + int(counters["expired"])
        self.ledger = {}

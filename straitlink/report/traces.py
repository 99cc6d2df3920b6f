"""Reads a run's JSON lines, of a folder or one file, and puts robot, operator and link on one time line."""

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
UNKNOWN = -1  # a figure of an estimate that was not told
_SENDS = {"robot": "down", "operator": "up"}  # the direction that a side sends into
_RECEIVES = {"robot": "up", "operator": "down"}
# What a side counts of a topic, and the name that a row of both sides' counters has for it.
_COUNTED_BY_SENDER = {
    name: name
    for name in ("offered", "decimated", "superseded", "expired", "overflow", "refused", "sent", "sent_bytes")
}
_COUNTED_BY_RECEIVER = {
    **{name: name for name in ("delivered", "lost", "stale", "unreadable", "received_bytes")},
    "expired": "expired_there",
}
_MALFORMED = (ValueError, KeyError, TypeError, AttributeError)


@dataclass(slots=True)
class Traces:
    """The events of a run, times in nanoseconds from its start, rows by topic or direction.

    sides: whose own traces there are, of robot, operator and link. reliable: topics whose sender waits
    for receipts. ledgers: counters of both sides by topic; expired_there is the receiver's "expired".
    delivered: (t, age, one-way delay, payload bytes). departures: (t, wire bytes). bands: (t, rate in
    bit/s). packets: (t, wire bytes, queue delay, dropped 0 | 1). estimates: (t, rate in bit/s, queue in ns,
    loss and confidence in ppm), each UNKNOWN where not told; told: the same of the direction that a side
    receives by, as its peer told it.
    """

    facts: Event = field(default_factory=dict)
    sides: set[str] = field(default_factory=set)
    duration_ns: int = 1
    topics: dict[str, str] = field(default_factory=dict)
    reliable: set[str] = field(default_factory=set)
    ledgers: dict[str, dict[str, int]] = field(default_factory=dict)
    delivered: Rows = field(default_factory=lambda: defaultdict(list))
    departures: Rows = field(default_factory=lambda: defaultdict(list))
    estimates: Rows = field(default_factory=lambda: defaultdict(list))
    told: Rows = field(default_factory=lambda: defaultdict(list))
    packets: Rows = field(default_factory=lambda: defaultdict(list))
    bands: Rows = field(default_factory=lambda: defaultdict(list))
    malformed_lines: int = 0

    def shift(self, origin_ns: int) -> None:
        """Count time from origin_ns."""
        for rows in self._all():
            for key, events in rows.items():
                rows[key] = [(event[0] - origin_ns, *event[1:]) for event in events]

    def last_ns(self) -> int:
        """Time of the last event."""
        return max(
            (event[0] for rows in self._all() for events in rows.values() for event in events), default=0
        )

    def _all(self) -> tuple[Rows, ...]:
        return self.delivered, self.departures, self.estimates, self.told, self.packets, self.bands


def is_trace(path: Path) -> bool:
    """Whether a file may be JSON lines: it begins with an object."""
    with path.open("rb") as stream:
        return stream.read(1) == b"{"


def read_traces(path: Path) -> Traces:
    """All that a run folder has, or the one trace that path is, whose start line names its side.

    Lines that are not JSON, or lack a field, are counted and passed over. Raises ValueError for a file
    without a start line, and for a run.json that is not JSON.
    """
    traces = Traces()
    files = {name: path / f"{name}.jsonl" for name in ("robot", "operator", "link")}
    if path.is_file():
        traces.facts = {"kind": "trace", "source": path.name}
        files = {"": path}
    elif (path / "run.json").exists():
        traces.facts = json.loads((path / "run.json").read_text())
    begins: dict[str, tuple[int, int]] = {}  # side -> (t_ns, unix_ns) of its first start line
    for name, file in files.items():
        if file.exists():
            trace = _TraceFile(traces, name)
            trace.read(file)
            if not trace.side:
                raise ValueError("no start line names the side that wrote it")
            traces.sides.add(trace.side)
            if trace.begin is not None:
                begins[trace.side] = trace.begin
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
    """One file's events, on unix time; a "start" line in its midst is a process that began again.

    side: "robot", "operator", "link", or "" until a start line tells.
    """

    def __init__(self, traces: Traces, side: str) -> None:
        self.traces = traces
        self.side = side
        self.unix_from_t_ns = 0
        self.begin: tuple[int, int] | None = None
        self.ledger: Event = {}
        self.take: dict[str, Callable[[Event, int], None]] = {
            "delivered": self._delivered,
            "sent": self._sent,
            "link_state": self._link_state,
            "ledger": self._ledger,
            "receipt": self._receipt,
            "packet": self._packet,
            "band": self._band,
        }

    def read(self, path: Path) -> None:
        with path.open(encoding="utf-8", errors="replace") as lines:
            for line in lines:
                try:
                    self._event(json.loads(line))
                except _MALFORMED:
                    self.traces.malformed_lines += 1
        self._bank_ledger()

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
        self.traces.estimates[_SENDS[self.side]].append(_estimate_row(event, t_ns))
        if "receiving" in event:
            told = event["receiving"]
            row = (t_ns, *(UNKNOWN,) * 4) if told is None else _estimate_row(told, t_ns)
            self.traces.told[_RECEIVES[self.side]].append(row)

    def _ledger(self, event: Event, t_ns: int) -> None:
        self.ledger = event["topics"]

    def _receipt(self, event: Event, t_ns: int) -> None:
        self.traces.reliable.add(event["topic"])

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
            for counted, name in (_COUNTED_BY_SENDER if sends else _COUNTED_BY_RECEIVER).items():
                if counters.get(counted) is not None:
                    row[name] = row.get(name, 0) + int(counters[counted])
        self.ledger = {}


def _estimate_row(event: Event, t_ns: int) -> tuple[int, ...]:
    ratios = (event.get(name) for name in ("loss_ratio", "confidence"))
    in_ppm = (UNKNOWN if ratio is None else round(ratio * 1e6) for ratio in ratios)
    return (t_ns, int(event["rate_bps"]), int(event.get("queue_ns", UNKNOWN)), *in_ppm)

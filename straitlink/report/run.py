"""A run as its traces tell it: one time line for robot, operator and link, arrays per topic and direction."""

from __future__ import annotations

from collections.abc import Mapping, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from mcap.exceptions import McapError
from mcap.reader import make_reader
from numpy.typing import NDArray

from straitlink.recording import is_mcap

from .traces import UNKNOWN, UNKNOWN_NS, Traces, is_trace, read_traces

Times = NDArray[np.int64]
DIRECTIONS = ("down", "up")  # down: robot to operator


class ReportError(Exception):
    """The run cannot be reported on; the message says which file and why."""


@dataclass(frozen=True, slots=True)
class Deliveries:
    """A topic's deliveries in order of time, (N,) int64 each, nanoseconds from the start of the run.

    age_ns and one_way_delay_ns are UNKNOWN_NS where the receiver could not tell yet; one_way_delay_ns
    is empty where the source never tells it (a recording).
    """

    t_ns: Times
    age_ns: Times
    one_way_delay_ns: Times
    payload_bytes: Times


def known(values_ns: Times) -> NDArray[np.bool_]:
    """Which delays or ages the receiver could tell."""
    return np.asarray(values_ns != UNKNOWN_NS, np.bool_)


@dataclass(frozen=True, slots=True)
class Packets:
    """Packets offered to the link, (N,) each: what the emulator did with them; t_ns is their entry."""

    t_ns: Times
    wire_bytes: Times
    queue_delay_ns: Times
    dropped: NDArray[np.bool_]

    def carried(self, end_ns: int) -> tuple[Times, Times]:
        """(t_ns, wire_bytes) of packets whose sending onto the link began before end_ns, when it did."""
        begun_ns = self.t_ns + self.queue_delay_ns
        through = ~self.dropped & (begun_ns < end_ns)
        return begun_ns[through], self.wire_bytes[through]


@dataclass(frozen=True, slots=True)
class Steps:
    """A quantity that holds from t_ns[i] until t_ns[i + 1], (N,) each."""

    t_ns: Times
    value: Times

    def at(self, t_ns: Times) -> Times:
        """The value at each time; the first one also before it began."""
        return self.value[np.maximum(np.searchsorted(self.t_ns, t_ns, side="right") - 1, 0)]

    def integral(self, end_ns: int) -> float:
        """Of value over seconds from 0 to end_ns."""
        begins = np.clip(self.t_ns, 0, end_ns)
        begins[0] = 0
        widths_ns = np.diff(np.append(begins, end_ns))
        return float(np.sum(self.value * (widths_ns / 1e9)))


@dataclass(frozen=True, slots=True)
class Departures:
    """Bytes that a side put on the wire, IP and UDP headers included, in bins that end at t_ns."""

    t_ns: Times
    wire_bytes: Times


@dataclass(frozen=True, slots=True)
class Estimate:
    """What a sender took its direction for from t_ns[i] until t_ns[i + 1], (N,) each; NaN where not told."""

    t_ns: Times
    rate_bps: NDArray[np.float64]
    queue_ns: NDArray[np.float64]
    loss_ratio: NDArray[np.float64]
    confidence: NDArray[np.float64]

    def at(self, values: NDArray[np.float64], t_ns: Times) -> NDArray[np.float64]:
        """One of the figures at each time; NaN before the first estimate."""
        rows = np.searchsorted(self.t_ns, t_ns, side="right") - 1
        return np.where(rows >= 0, values[np.maximum(rows, 0)], np.nan)


@dataclass(frozen=True, slots=True)
class Run:
    """All that is known of a run. Times are nanoseconds from its start; maps miss what no trace told.

    topics: direction by topic. ledgers: final counters by topic, of both ends. sides: whose own traces
    there are. estimates: by the sender's own trace, or else as its peer was told. reliable: topics whose
    sender counts as expired what came too late, for it was told.
    """

    facts: Mapping[str, Any]
    duration_ns: int
    topics: Mapping[str, str]
    deliveries: Mapping[str, Deliveries]
    ledgers: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    departures: Mapping[str, Departures] = field(default_factory=dict)
    estimates: Mapping[str, Estimate] = field(default_factory=dict)
    packets: Mapping[str, Packets] = field(default_factory=dict)
    bands: Mapping[str, Steps] = field(default_factory=dict)
    malformed_lines: int = 0
    sides: Set[str] = frozenset()
    reliable: Set[str] = frozenset()


def read_run(path: Path) -> Run:
    """A run folder (run.json, robot.jsonl, operator.jsonl, link.jsonl; any may miss), a single trace of any
    name, or an MCAP recording.

    Raises ReportError if there is nothing to report on.
    """
    if not path.exists():
        raise ReportError(f"{path}: no such file or folder")
    try:
        if path.is_file() and not is_trace(path):
            return _from_recording(path)
        traces = read_traces(path)
    except (OSError, ValueError) as error:
        raise ReportError(f"cannot read the run in {path}: {error}") from error
    if not traces.sides:
        raise ReportError(f"{path} has none of robot.jsonl, operator.jsonl, link.jsonl: not a run folder")
    return _from_traces(traces)


def _from_traces(traces: Traces) -> Run:
    return Run(
        facts=traces.facts,
        duration_ns=traces.duration_ns,
        topics=traces.topics,
        deliveries={topic: _deliveries(rows) for topic, rows in traces.delivered.items()},
        ledgers=traces.ledgers,
        departures={side: Departures(*_columns(rows, 2)) for side, rows in traces.departures.items()},
        estimates={side: _estimate(rows) for side, rows in {**traces.told, **traces.estimates}.items()},
        packets={side: _packets(rows) for side, rows in traces.packets.items()},
        bands={side: Steps(*_columns(rows, 2)) for side, rows in traces.bands.items()},
        malformed_lines=traces.malformed_lines,
        sides=traces.sides,
        reliable=traces.reliable,
    )


def _from_recording(path: Path) -> Run:
    """Deliveries by log_time, aged by publish_time: true where both clocks agree."""
    topics: dict[str, list[tuple[int, ...]]] = {}
    try:
        with path.open("rb") as stream:
            if not is_mcap(stream):
                raise ReportError(f"{path} is not an MCAP file, nor a trace of JSON lines")
            for _schema, channel, message in make_reader(stream).iter_messages():
                age_ns = message.log_time - message.publish_time
                row = (message.log_time, age_ns, len(message.data))
                topics.setdefault(channel.topic.lstrip("/"), []).append(row)
    except (McapError, OSError, ValueError) as error:
        raise ReportError(f"{path} is not a finished MCAP file ({error}); recover it first") from error
    if not topics:
        raise ReportError(f"{path} has no messages")
    start_ns = min(rows[0][0] for rows in topics.values())
    end_ns = max(rows[-1][0] for rows in topics.values())
    deliveries = {}
    for topic, rows in topics.items():
        arrivals_ns, ages_ns, payload_bytes = _columns(rows, 3)
        deliveries[topic] = Deliveries(arrivals_ns - start_ns, ages_ns, np.empty(0, np.int64), payload_bytes)
    facts = {"kind": "recording", "source": path.name, "start_unix_ns": start_ns}
    return Run(facts, max(end_ns - start_ns, 1), dict.fromkeys(topics, "down"), deliveries)


def _deliveries(rows: list[tuple[int, ...]]) -> Deliveries:
    t_ns, age_ns, one_way_delay_ns, payload_bytes = _columns(rows, 4)
    return Deliveries(t_ns, age_ns, one_way_delay_ns, payload_bytes)


def _estimate(rows: list[tuple[int, ...]]) -> Estimate:
    t_ns, *figures = _columns(rows, 5)
    rate_bps, queue_ns, loss, confidence = (np.where(f == UNKNOWN, np.nan, f) for f in figures)
    return Estimate(t_ns, rate_bps, queue_ns, loss / 1e6, confidence / 1e6)


def _packets(rows: list[tuple[int, ...]]) -> Packets:
    t_ns, wire_bytes, queue_delay_ns, dropped = _columns(rows, 4)
    return Packets(t_ns, wire_bytes, queue_delay_ns, dropped.astype(np.bool_))


def _columns(rows: list[tuple[int, ...]], width: int) -> list[Times]:
    """Rows, in order of their first entry, as columns."""
    table = np.array(rows, np.int64).reshape(-1, width)
    return list(table[np.argsort(table[:, 0], kind="stable")].T)

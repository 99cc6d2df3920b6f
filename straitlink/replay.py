"""Publishes a recorded log on a Zenoh bus with the log's own timing, payload bytes untouched."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, cast

import zenoh
from mcap.reader import McapReader
from mcap.records import Channel
from mcap.summary import Summary

from messages.attachment import Stamp
from shaper.bus import BusSettings, open_bus

from .replay_log import ReplayError, channel_encoding, open_log, selected_time, topic_key
from .replay_timing import NS_PER_S, Lateness, Pass

__all__ = [
    "Progress",
    "ReplayError",
    "ReplaySettings",
    "ReplaySummary",
    "channel_encoding",
    "replay",
    "topic_key",
]

_PROGRESS_INTERVAL_NS = 100_000_000
_LATE_SUBSCRIBER_NS = 300_000_000  # on one host subscriptions are told within milliseconds of each other
# One wake-up publishes all that came due: at 4,000 messages/s this halves the CPU of one sleep per
# message and costs half a millisecond of lateness.
_WAKE_UP_QUANTUM_S = 0.0005
_LONG_WAIT_S = 0.05  # longer waits listen for the stop request


@dataclass(frozen=True, slots=True)
class Progress:
    """Where a replay is: position_s and duration_s in log time of the selected part, this pass."""

    messages: int
    payload_bytes: int
    position_s: float
    duration_s: float
    pass_number: int


@dataclass(frozen=True, slots=True)
class ReplaySettings:
    """What to publish, where and how fast.

    rate: log seconds per wall second. loop: passes over the log; 0 repeats until stopped.
    include, exclude: topics ("/scan") or key expressions ("camera/**"); an empty include takes all.
    start_s, end_s: part of the log to publish, from its first message.
    stamp: "now" moves capture times to this host's present (see docs/recordings.md), "log" keeps them.
    subscriber_wait_s: how long the first message waits for a subscriber of each topic; puts before
    a match are lost.
    """

    log: Path
    bus: BusSettings
    rate: float = 1.0
    loop: int = 1
    include: Sequence[str] = ()
    exclude: Sequence[str] = ()
    start_s: float = 0.0
    end_s: float | None = None
    stamp: Literal["now", "log"] = "now"
    subscriber_wait_s: float = 3.0
    stop: threading.Event = field(default_factory=threading.Event)
    on_progress: Callable[[Progress], None] | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.rate <= 1000.0:
            raise ReplayError(f"replay rate = {self.rate} must be > 0 and <= 1000")
        if self.loop < 0:
            raise ReplayError(f"replay loop = {self.loop} must be >= 0 (0 repeats until stopped)")
        if self.start_s < 0.0:
            raise ReplayError(f"replay start_s = {self.start_s} must be >= 0")
        if self.end_s is not None and self.end_s <= self.start_s:
            raise ReplayError(f"replay end_s = {self.end_s} must be > start_s = {self.start_s}")
        if self.stamp not in ("now", "log"):
            raise ReplayError(f'replay stamp = {self.stamp!r} must be "now" or "log"')


@dataclass(frozen=True, slots=True)
class ReplaySummary:
    """What was published, over so many whole passes.

    Lateness is how long after its due time a message was handed to Zenoh. unmatched_topics had no
    subscriber when the replay began.
    """

    messages: int
    payload_bytes: int
    topics: dict[str, int]
    unmatched_topics: tuple[str, ...]
    passes: int
    wall_s: float
    late_p50_ms: float
    late_p95_ms: float
    late_max_ms: float
    stopped: bool


def replay(settings: ReplaySettings) -> ReplaySummary:
    """Publish the log and return when its last message is out, or soon after settings.stop is set.

    Raises ReplayError for a log that cannot be read or holds no matching topic, and
    shaper.bus.BusError if the bus cannot be opened.
    """
    with open_log(settings.log) as (reader, summary):
        channels = _selected(summary, settings)
        # Refuses an empty part before the bus is opened.
        selected_time(summary, settings.start_s, settings.end_s)
        session = open_bus(settings.bus)
        try:
            return _Run(settings, reader, summary, _declare(session, summary, channels)).publish_all()
        finally:
            session.close()


def _selected(summary: Summary, settings: ReplaySettings) -> dict[int, Channel]:
    """The channels to publish, by id. A topic that cannot be a key may still be excluded by its name."""
    include = [_expression(name) for name in settings.include]
    exclude = [_expression(name) for name in settings.exclude if name not in _topics(summary)]

    def wanted(topic: str) -> bool:
        if topic in settings.exclude or _meets(exclude, topic):
            return False
        return not include or topic in settings.include or _meets(include, topic)

    channels = {number: channel for number, channel in summary.channels.items() if wanted(channel.topic)}
    if not channels:
        raise ReplayError(
            f"no topic of {settings.log} is selected; it has {', '.join(sorted(_topics(summary)))}"
        )
    return channels


def _topics(summary: Summary) -> set[str]:
    return {channel.topic for channel in summary.channels.values()}


def _meets(expressions: Sequence[zenoh.KeyExpr], topic: str) -> bool:
    return bool(expressions) and any(expression.intersects(topic_key(topic)) for expression in expressions)


def _expression(name: str) -> zenoh.KeyExpr:
    try:
        return zenoh.KeyExpr.autocanonize(name.strip("/"))
    except zenoh.ZError as error:
        raise ReplayError(f"{name!r} is neither a topic nor a key expression: {error}") from error


class _Outlet:
    """One channel's publisher and its running sequence number."""

    __slots__ = ("count", "publisher", "sequence", "topic")

    def __init__(self, publisher: zenoh.Publisher, topic: str) -> None:
        self.publisher = publisher
        self.topic = topic
        self.sequence = -1
        self.count = 0

    @property
    def matched(self) -> bool:
        # The stub promises a bool; what comes is a MatchingStatus, which is always true.
        return cast(zenoh.MatchingStatus, self.publisher.matching_status).matching

    def next_sequence(self, logged: int, first_pass: bool) -> int:
        """The log's own number; ours where the log does not count, and after the first pass."""
        self.sequence = logged if first_pass and logged else self.sequence + 1
        self.count += 1
        return self.sequence


def _declare(session: zenoh.Session, summary: Summary, channels: dict[int, Channel]) -> dict[int, _Outlet]:
    """A publisher per channel, blocking when the bus is full.

    20,000 puts of 1,250 B in a burst on loopback: BLOCK delivers all of them, DROP 12,016, and put()
    tells neither. Session.close() sends what a BLOCK publisher has queued.
    """
    return {
        number: _Outlet(
            session.declare_publisher(
                topic_key(channel.topic),
                encoding=channel_encoding(channel, summary),
                congestion_control=zenoh.CongestionControl.BLOCK,
            ),
            channel.topic,
        )
        for number, channel in channels.items()
    }


class _Run:
    """The passes over one log."""

    def __init__(
        self, settings: ReplaySettings, reader: McapReader, summary: Summary, outlets: dict[int, _Outlet]
    ) -> None:
        self.settings = settings
        self.reader = reader
        self.outlets = outlets
        self.start_ns, self.end_ns = selected_time(summary, settings.start_s, settings.end_s)
        self.lateness = Lateness()
        self.messages = 0
        self.payload_bytes = 0
        self.passes = 0
        self.progress_at_ns = 0

    def publish_all(self) -> ReplaySummary:
        """Every pass, each starting where the one before it ends; then what happened."""
        unmatched = self._wait_for_subscribers()
        started_ns, wall_ns = time.monotonic_ns(), time.time_ns()
        pass_ns = round((self.end_ns - self.start_ns) / self.settings.rate)
        stop = self.settings.stop
        while not stop.is_set() and (self.settings.loop == 0 or self.passes < self.settings.loop):
            shift_ns = self.passes * pass_ns
            begins_ns = (self.start_ns, started_ns + shift_ns, wall_ns + shift_ns)
            current = Pass(self.settings.rate, self.settings.stamp, *begins_ns)
            if self._publish(current):
                self.passes += 1
        return ReplaySummary(
            messages=self.messages,
            payload_bytes=self.payload_bytes,
            topics=self._counts(),
            unmatched_topics=unmatched,
            passes=self.passes,
            wall_s=(time.monotonic_ns() - started_ns) / NS_PER_S,
            late_p50_ms=self.lateness.quantile_ms(0.50),
            late_p95_ms=self.lateness.quantile_ms(0.95),
            late_max_ms=self.lateness.max_ns / 1e6,
            stopped=stop.is_set(),
        )

    def _publish(self, current: Pass) -> bool:
        """False where a stop cuts the pass short."""
        topics = {outlet.topic for outlet in self.outlets.values()}
        records = self.reader.iter_messages(topics, starting_at=self.start_ns, ending_before=self.end_ns)
        for _schema, _channel, message in records:
            outlet = self.outlets.get(message.channel_id)
            if outlet is None:
                continue
            offset_ns = current.offset_ns(message.log_time)
            due_ns = current.origin_ns + offset_ns
            if not self._wait_until(due_ns):
                return False
            capture_ns = current.capture_ns(message, offset_ns)
            sequence = outlet.next_sequence(message.sequence, first_pass=self.passes == 0)
            outlet.publisher.put(message.data, attachment=Stamp(capture_ns, sequence).encode())
            self.messages += 1
            self.payload_bytes += len(message.data)
            now_ns = time.monotonic_ns()
            self.lateness.add(now_ns - due_ns)
            if now_ns >= self.progress_at_ns:
                self._report(message.log_time, now_ns)
        return True

    def _wait_until(self, due_ns: int) -> bool:
        """False once a stop is requested."""
        stop = self.settings.stop
        while (wait_s := (due_ns - time.monotonic_ns()) / NS_PER_S) > 0.0:
            if wait_s > _LONG_WAIT_S:
                stop.wait(wait_s - _LONG_WAIT_S)
                if stop.is_set():
                    return False
            else:
                time.sleep(max(wait_s, _WAKE_UP_QUANTUM_S))
        return not stop.is_set()

    def _wait_for_subscribers(self) -> tuple[str, ...]:
        """Topics still without a subscriber when the wait is over.

        Some topics may have none at all: once others have, it ends when no more come for a while.
        """
        limit_ns = time.monotonic_ns() + round(self.settings.subscriber_wait_s * NS_PER_S)
        give_up_ns = limit_ns
        waiting = list(self.outlets.values())
        left = len(waiting)
        while waiting := [outlet for outlet in waiting if not outlet.matched]:
            now_ns = time.monotonic_ns()
            if len(waiting) < left:
                left = len(waiting)
                give_up_ns = min(limit_ns, now_ns + _LATE_SUBSCRIBER_NS)
            if now_ns >= give_up_ns or self.settings.stop.wait(0.005):
                break
        return tuple(sorted({outlet.topic for outlet in waiting}))

    def _counts(self) -> dict[str, int]:
        counts: dict[str, int] = {}
        for outlet in self.outlets.values():
            counts[outlet.topic] = counts.get(outlet.topic, 0) + outlet.count
        return dict(sorted(counts.items()))

    def _report(self, log_time_ns: int, now_ns: int) -> None:
        self.progress_at_ns = now_ns + _PROGRESS_INTERVAL_NS
        if self.settings.on_progress is not None:
            position_s = (log_time_ns - self.start_ns) / NS_PER_S
            duration_s = (self.end_ns - self.start_ns) / NS_PER_S
            progress = Progress(self.messages, self.payload_bytes, position_s, duration_s, self.passes + 1)
            self.settings.on_progress(progress)

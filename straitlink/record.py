"""Records a Zenoh bus into MCAP: log_time is arrival, publish_time is capture."""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import zenoh
from mcap.exceptions import McapError

from messages.attachment import decode_stamp
from shaper.bus import BusSettings, open_bus

from .recording import AttachedFile, RecordError, RecordingFile, is_mcap
from .schemas import SchemaLibrary

__all__ = [
    "AttachedFile",
    "RecordError",
    "RecordProgress",
    "RecordSettings",
    "RecordSummary",
    "Recorder",
    "record",
]

_DRAIN_INTERVAL_S = 0.02  # the writer takes arrivals in batches: a wake-up per message costs CPU


@dataclass(frozen=True, slots=True)
class RecordProgress:
    """So far: messages and payload bytes written, messages dropped, messages waiting for the disk."""

    messages: int
    payload_bytes: int
    dropped: int
    waiting: int


@dataclass(frozen=True, slots=True)
class RecordSettings:
    """What to record, where to.

    overwrite: replace `out` where it exists; a recording is refused its place otherwise.
    keys: Zenoh key expressions; "**" matches all but chunks that begin with "@".
    logs: MCAP files whose schemas the recording may need, such as the log being replayed.
    metadata: strings for the file's metadata record, beside the clocks that we add.
    flush_interval_s: a kill -9 loses at most what arrived in the last so many seconds; 0 < s <= 1.
    queue_bytes: payload that may wait for a stalled disk before arrivals are dropped and counted.
    """

    out: Path
    bus: BusSettings
    overwrite: bool = False
    keys: Sequence[str] = ("**",)
    logs: Sequence[Path] = ()
    metadata: Mapping[str, str] = field(default_factory=dict)
    attachments: Sequence[AttachedFile] = ()
    flush_interval_s: float = 1.0
    queue_bytes: int = 64 * 1024 * 1024
    stop: threading.Event = field(default_factory=threading.Event)
    on_ready: Callable[[], None] | None = None
    on_progress: Callable[[RecordProgress], None] | None = None

    def __post_init__(self) -> None:
        if not self.keys:
            raise RecordError("record keys is empty: give at least one key expression")
        if not 0.0 < self.flush_interval_s <= 1.0:
            raise RecordError(f"record flush_interval_s = {self.flush_interval_s} must be > 0 and <= 1")
        if self.queue_bytes <= 0:
            raise RecordError(f"record queue_bytes = {self.queue_bytes} must be > 0")


@dataclass(frozen=True, slots=True)
class RecordSummary:
    """What the recording holds. topics: messages per topic. schemaless: topics whose schema nobody knew."""

    path: Path
    messages: int
    payload_bytes: int
    dropped: int
    topics: dict[str, int]
    schemaless: tuple[str, ...]
    wall_s: float


def record(settings: RecordSettings) -> RecordSummary:
    """Record until settings.stop is set; the file is complete when this returns, and also if it raises.

    Raises RecordError if the file exists or cannot be written, shaper.bus.BusError if the bus cannot
    be opened: then no file is made, and none that exists is touched.
    """
    recorder = Recorder(settings)
    try:
        recorder.start()
        while not settings.stop.wait(0.1) and recorder.alive:
            if settings.on_progress is not None:
                settings.on_progress(recorder.progress)
    finally:
        summary = recorder.close()
    return summary


class Recorder:
    """A recording in progress: Zenoh's threads append arrivals, one thread of ours writes them."""

    def __init__(self, settings: RecordSettings) -> None:
        if settings.out.exists() and not settings.overwrite:
            raise RecordError(f"{settings.out} exists: give another name, or --overwrite to replace it")
        self._settings = settings
        self._arrivals = _Arrivals(settings.queue_bytes)
        self._keys = list(_subscriptions(settings.keys))
        library = _library(settings.logs)
        self._session = open_bus(settings.bus)  # first: a bus that is not there costs no earlier recording
        try:
            self._file = RecordingFile(_open_out(settings), library)
            self._describe()
        except OSError as error:
            self._session.close()
            raise RecordError(f"cannot write {settings.out}: {error.strerror}") from error
        self._closing = threading.Event()
        self._failure: Exception | None = None
        self._writer = threading.Thread(target=self._write, name="recorder", daemon=True)
        self._started_ns = time.monotonic_ns()

    def start(self) -> None:
        """Subscribe."""
        self._writer.start()
        for key, earlier in self._keys:
            self._session.declare_subscriber(key, _callback(self._arrivals, earlier))
        if self._settings.on_ready is not None:
            self._settings.on_ready()

    @property
    def alive(self) -> bool:
        """False once the writer has failed."""
        return self._failure is None

    @property
    def progress(self) -> RecordProgress:
        file, arrivals = self._file, self._arrivals
        return RecordProgress(file.messages, file.payload_bytes, arrivals.dropped, len(arrivals))

    def close(self) -> RecordSummary:
        """Unsubscribe, write what has arrived and finish the file."""
        self._session.close()
        self._closing.set()
        self._writer.join()
        if self._failure is not None:
            raise RecordError(f"cannot write {self._settings.out}: {self._failure}") from self._failure
        return RecordSummary(
            path=self._settings.out,
            messages=self._file.messages,
            payload_bytes=self._file.payload_bytes,
            dropped=self._arrivals.dropped,
            topics=dict(sorted(self._file.topics.items())),
            schemaless=tuple(sorted(self._file.schemaless)),
            wall_s=(time.monotonic_ns() - self._started_ns) / 1e9,
        )

    def _describe(self) -> None:
        """The file's metadata record and attachments, on disk before the first message."""
        wall_ns = time.time_ns()
        clocks = {"unix_ns": str(wall_ns), "monotonic_ns": str(time.monotonic_ns())}
        facts = {**clocks, "keys": " ".join(self._settings.keys), **self._settings.metadata}
        self._file.add_metadata("straitlink", facts)
        ours = AttachedFile("recording.json", "application/json", json.dumps(facts, indent=1).encode())
        for attached in (ours, *self._settings.attachments):
            self._file.add_attachment(attached, wall_ns, wall_ns)
        self._file.flush()

    def _write(self) -> None:
        interval_ns = round(self._settings.flush_interval_s * 0.9e9)  # the writing itself takes time
        flush_at_ns = time.monotonic_ns() + interval_ns
        try:
            while not self._closing.wait(_DRAIN_INTERVAL_S):
                self._drain()
                if time.monotonic_ns() >= flush_at_ns:
                    self._file.flush()
                    flush_at_ns = time.monotonic_ns() + interval_ns
            self._drain()
            self._file.finish()
        except Exception as error:  # a thread's exception is nobody's: close() raises it
            self._failure = error

    def _drain(self) -> None:
        while (arrival := self._arrivals.take()) is not None:
            arrival_ns, sample = arrival
            attachment = sample.attachment
            self._file.write(
                topic="/" + str(sample.key_expr),
                encoding=str(sample.encoding),
                payload=sample.payload.to_bytes(),
                stamp=None if attachment is None else decode_stamp(attachment.to_bytes()),
                arrival_ns=arrival_ns,
            )


class _Arrivals:
    """What has arrived and is not yet written, bounded in bytes; any thread may add, one takes."""

    # A waiting sample costs memory beside its payload.
    SAMPLE_BYTES = 512

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._samples: deque[tuple[int, zenoh.Sample, int]] = deque()
        self._bytes = 0
        self._lock = threading.Lock()
        self.dropped = 0

    def __len__(self) -> int:
        return len(self._samples)

    def add(self, arrival_ns: int, sample: zenoh.Sample) -> None:
        sample_bytes = len(sample.payload) + self.SAMPLE_BYTES
        with self._lock:
            if self._bytes + sample_bytes > self._max_bytes and self._samples:
                self.dropped += 1
                return
            self._bytes += sample_bytes
            self._samples.append((arrival_ns, sample, sample_bytes))

    def take(self) -> tuple[int, zenoh.Sample] | None:
        with self._lock:
            if not self._samples:
                return None
            arrival_ns, sample, sample_bytes = self._samples.popleft()
            self._bytes -= sample_bytes
            return arrival_ns, sample


def _library(logs: Sequence[Path]) -> SchemaLibrary:
    library = SchemaLibrary()
    for log in logs:
        try:
            with log.open("rb") as stream:
                if not is_mcap(stream):
                    raise RecordError(f"record schemas: {log} is not an MCAP file")
            library.add_log(log)
        except OSError as error:
            raise RecordError(f"record schemas: cannot read {log}: {error.strerror}") from error
        except (McapError, ValueError) as error:
            raise RecordError(
                f"record schemas: {log} is not a finished MCAP file ({error}); recover it first"
            ) from error
    return library


def _open_out(settings: RecordSettings) -> IO[bytes]:
    return settings.out.open("wb" if settings.overwrite else "xb")


def _callback(arrivals: _Arrivals, earlier: Sequence[zenoh.KeyExpr]) -> Callable[[zenoh.Sample], None]:
    def on_sample(sample: zenoh.Sample) -> None:
        arrival_ns = time.time_ns()
        twice = any(key.intersects(sample.key_expr) for key in earlier)
        if sample.kind == zenoh.SampleKind.PUT and not twice:
            arrivals.add(arrival_ns, sample)

    return on_sample


def _subscriptions(keys: Sequence[str]) -> Iterator[tuple[zenoh.KeyExpr, list[zenoh.KeyExpr]]]:
    """Each expression with the earlier ones that overlap it, whose samples it must not record again."""
    seen: list[zenoh.KeyExpr] = []
    for text in keys:
        try:
            key = zenoh.KeyExpr.autocanonize(text.strip("/"))
        except zenoh.ZError as error:
            raise RecordError(f"record keys: {text!r} is not a key expression: {error}") from error
        yield key, [earlier for earlier in seen if earlier.intersects(key)]
        seen.append(key)

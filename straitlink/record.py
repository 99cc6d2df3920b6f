"""Records a Zenoh bus into MCAP: log_time is arrival, publish_time is capture."""

from __future__ import annotations

import io
import json
import struct
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import IO

import zenoh
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, McapRecord, Message, Metadata
from mcap.records import Schema as SchemaRecord
from mcap.stream_reader import breakup_chunk
from mcap.writer import Writer
from zstandard import ZstdError

from messages.attachment import Stamp, decode_stamp
from shaper.bus import BusSettings, open_bus

from .schemas import ZENOH_ENCODING_KEY, Schema, SchemaLibrary, payload_type

_CHUNK_BYTES = 1024 * 1024
_DRAIN_INTERVAL_S = 0.02  # the writer takes arrivals in batches: a wake-up per message costs CPU
_NANOSECONDS_MAX = 2**64 - 1  # MCAP's times are unsigned
_MAGIC = b"\x89MCAP0\r\n"
_RECORD_HEAD = struct.Struct("<BQ")  # opcode, length
_MAX_RECORD_BYTES = 1 << 30  # a longer record is a damaged length
# What a damaged record makes mcap and the decompressors raise.
_DAMAGE = (McapError, ValueError, ZstdError, struct.error, RuntimeError, MemoryError)


class RecordError(Exception):
    """The recording cannot be made or read; the message says which file and why."""


@dataclass(frozen=True, slots=True)
class AttachedFile:
    """A file carried inside the recording, such as the resolved configuration as JSON."""

    name: str
    media_type: str
    data: bytes


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

    keys: Zenoh key expressions; "**" matches all but chunks that begin with "@".
    logs: MCAP files whose schemas the recording may need, such as the log being replayed.
    metadata: strings for the file's metadata record, beside the clocks that we add.
    flush_interval_s: a kill -9 loses at most what arrived in the last so many seconds; 0 < s <= 1.
    queue_bytes: payload that may wait for a stalled disk before arrivals are dropped and counted.
    """

    out: Path
    bus: BusSettings
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

    Raises RecordError if the file cannot be written, shaper.bus.BusError if the bus cannot be opened.
    """
    recorder = Recorder(settings)
    recorder.start()
    try:
        while not settings.stop.wait(0.1) and recorder.alive:
            if settings.on_progress is not None:
                settings.on_progress(recorder.progress)
    finally:
        summary = recorder.close()
    return summary


class Recorder:
    """A recording in progress: Zenoh's threads append arrivals, one thread of ours writes them."""

    def __init__(self, settings: RecordSettings) -> None:
        self._settings = settings
        self._arrivals = _Arrivals(settings.queue_bytes)
        library = SchemaLibrary()
        for log in settings.logs:
            library.add_log(log)
        try:
            stream: IO[bytes] = settings.out.open("wb")
        except OSError as error:
            raise RecordError(f"cannot write {settings.out}: {error.strerror}") from error
        self._file = RecordingFile(stream, library)
        self._describe()
        self._closing = threading.Event()
        self._failure: Exception | None = None
        self._writer = threading.Thread(target=self._write, name="recorder", daemon=True)
        self._session: zenoh.Session | None = None
        self._started_ns = time.monotonic_ns()

    def start(self) -> None:
        """Open the bus and subscribe."""
        try:
            self._session = open_bus(self._settings.bus)
            for key, earlier in _subscriptions(self._settings.keys):
                self._session.declare_subscriber(key, _callback(self._arrivals, earlier))
        finally:
            self._writer.start()
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
        if self._session is not None:
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


class RecordingFile:
    """An MCAP file being written: channels and schemas appear as their first message does."""

    def __init__(self, stream: IO[bytes], library: SchemaLibrary | None = None) -> None:
        self._stream = stream
        self._library = library or SchemaLibrary()
        # Summary offsets are optional, and mcap 1.6.0 writes them for empty groups, which checkers
        # call an error.
        self._writer = Writer(stream, chunk_size=_CHUNK_BYTES, use_summary_offsets=False)
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[tuple[str, str], int] = {}
        self._message_encodings: set[str] = set()
        self.messages = 0
        self.payload_bytes = 0
        self.topics: Counter[str] = Counter()
        self.schemaless: set[str] = set()
        self._writer.start(*_header(ros2=False))

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        self._writer.add_metadata(name, dict(values))

    def add_attachment(self, file: AttachedFile, create_time_ns: int, log_time_ns: int) -> None:
        self._writer.add_attachment(create_time_ns, log_time_ns, file.name, file.media_type, file.data)

    def write(self, topic: str, encoding: str, payload: bytes, stamp: Stamp | None, arrival_ns: int) -> None:
        """Append one message of a bus; encoding is its Zenoh encoding string."""
        channel = self._channels.get((topic, encoding))
        if channel is None:
            channel = self._channels[topic, encoding] = self._bus_channel(topic, encoding)
        capture_ns = arrival_ns if stamp is None else stamp.capture_ns
        sequence = 0 if stamp is None else stamp.sequence
        self.add_message(channel, topic, payload, arrival_ns, capture_ns, sequence)

    def add_message(
        self, channel: int, topic: str, payload: bytes, log_time_ns: int, publish_time_ns: int, sequence: int
    ) -> None:
        """Append one message of a channel that register() has made."""
        publish_time_ns = min(max(publish_time_ns, 0), _NANOSECONDS_MAX)
        self._writer.add_message(channel, log_time_ns, payload, publish_time_ns, sequence)
        self.messages += 1
        self.payload_bytes += len(payload)
        self.topics[topic] += 1

    def register(
        self, topic: str, message_encoding: str, schema: Schema | None, metadata: Mapping[str, str]
    ) -> int:
        """A new channel's id; schema None makes it schemaless."""
        self._message_encodings.add(message_encoding)
        schema_id = 0
        if schema is not None:
            key = (schema.name, schema.encoding, schema.data)
            if key not in self._schemas:
                self._schemas[key] = self._writer.register_schema(*key)
            schema_id = self._schemas[key]
        return self._writer.register_channel(topic, message_encoding, schema_id, dict(metadata))

    def flush(self) -> None:
        """Close the chunk in progress and hand it to the operating system."""
        self._writer.flush()

    def finish(self) -> None:
        """Write the summary, and the profile now that every channel is known; close the file."""
        with self._stream:
            self._writer.finish()
            if self._message_encodings == {"cdr"}:
                self._stream.seek(0)
                Writer(self._stream).start(*_header(ros2=True))

    def _bus_channel(self, topic: str, encoding: str) -> int:
        described = payload_type(encoding)
        schema = self._library.find(described)
        metadata: dict[str, str] = {}
        if schema is None:
            self.schemaless.add(topic)
            metadata[ZENOH_ENCODING_KEY] = encoding  # keeps the name that the encoding gave
        return self.register(topic, described.message_encoding, schema, metadata)


def _header(ros2: bool) -> tuple[str, str]:
    """MCAP profile and library, of one length either way, so that finish() can replace one by the other.

    The profile "ros2" promises that all is CDR, and rosbags opens nothing else; which of the two a
    file is turns out at its end.
    """
    try:
        library = f"straitlink {version('straitlink')}"
    except PackageNotFoundError:  # run from a checkout
        library = "straitlink"
    return ("ros2", library) if ros2 else ("", library.ljust(len(library) + len("ros2")))


def recover(path: Path, out: Path | None = None, message_encodings: Sequence[str] = ()) -> Path:
    """Copy what is intact of an unfinished or damaged MCAP file into a finished one; returns its path.

    out: by default NAME_recovered.mcap beside it. message_encodings: copy only these, for instance
    ("cdr",) to make of a mixed recording the ROS 2 bag that rosbags reads.
    Chunks cut short or with a wrong checksum are left out. Raises RecordError for a file that is not
    MCAP at all, or for out = path.
    """
    out = path.with_name(f"{path.stem}_recovered{path.suffix}") if out is None else out
    if out.resolve() == path.resolve():
        raise RecordError(f"recover: out = {out} is the file to be recovered itself")
    with path.open("rb") as stream:
        _check_magic(stream)
        with out.open("wb") as copy:
            _copy(_records(stream), copy, message_encodings)
    return out


def _copy(records: Iterable[McapRecord], stream: IO[bytes], message_encodings: Sequence[str]) -> None:
    file = RecordingFile(stream)
    schemas: dict[int, Schema] = {}
    channels: dict[int, tuple[int, str]] = {}
    for record in records:
        match record:
            case SchemaRecord():
                schemas[record.id] = Schema(record.name, record.encoding, record.data)
            case Channel() if record.id not in channels:
                if not message_encodings or record.message_encoding in message_encodings:
                    schema = schemas.get(record.schema_id)
                    made = file.register(record.topic, record.message_encoding, schema, record.metadata)
                    channels[record.id] = (made, record.topic)
            case Message() if record.channel_id in channels:
                made, topic = channels[record.channel_id]
                times = (record.log_time, record.publish_time)
                file.add_message(made, topic, record.data, *times, record.sequence)
            case Attachment():
                attached = AttachedFile(record.name, record.media_type, record.data)
                file.add_attachment(attached, record.create_time, record.log_time)
            case Metadata():
                file.add_metadata(record.name, record.metadata)
    file.finish()


_READ: dict[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.SCHEMA: SchemaRecord.read,
    Opcode.CHANNEL: Channel.read,
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.METADATA: Metadata.read,
}


def intact_records(stream: IO[bytes]) -> Iterator[McapRecord]:
    """Schemas, channels, messages, attachments and metadata of an MCAP file, up to where it is whole.

    mcap's own readers need a footer, or mistake a record cut short for a whole one. Raises
    RecordError if the stream does not begin as MCAP does.
    """
    _check_magic(stream)
    yield from _records(stream)


def _check_magic(stream: IO[bytes]) -> None:
    if stream.read(len(_MAGIC)) != _MAGIC:
        raise RecordError(f"{getattr(stream, 'name', 'the stream')} does not begin with MCAP's magic bytes")


def _records(stream: IO[bytes]) -> Iterator[McapRecord]:
    while len(head := stream.read(_RECORD_HEAD.size)) == _RECORD_HEAD.size:
        opcode, length = _RECORD_HEAD.unpack(head)
        if opcode in (Opcode.DATA_END, Opcode.FOOTER):
            return
        data = stream.read(min(length, _MAX_RECORD_BYTES))
        if len(data) < length:
            return
        try:
            yield from _parse(opcode, data)
        except _DAMAGE:
            continue


def _parse(opcode: int, data: bytes) -> list[McapRecord]:
    stream = ReadDataStream(io.BytesIO(data))
    if opcode == Opcode.CHUNK:
        return breakup_chunk(Chunk.read(stream), validate_crc=True)
    if opcode == Opcode.MESSAGE:
        return [Message.read(stream, len(data))]
    return [_READ[opcode](stream)] if opcode in _READ else []

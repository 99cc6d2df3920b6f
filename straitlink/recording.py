"""A recording as an MCAP file: written so that a cut-off loses little, and read as far as it is whole."""

from __future__ import annotations

import io
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import IO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, McapRecord, Message, Metadata
from mcap.records import Schema as SchemaRecord
from mcap.stream_reader import breakup_chunk
from mcap.writer import Writer
from zstandard import ZstdError

from messages.attachment import Stamp

from .schemas import ZENOH_ENCODING_KEY, Schema, SchemaLibrary, payload_type

_CHUNK_BYTES = 1024 * 1024
_NANOSECONDS_MAX = 2**64 - 1  # MCAP's times are unsigned
_MAGIC = b"\x89MCAP0\r\n"
_RECORD_HEAD = struct.Struct("<BQ")  # opcode, length
_MAX_RECORD_BYTES = 1 << 30  # a longer record is a damaged length
# What a damaged record makes mcap and the decompressors raise.
_DAMAGE = (McapError, ValueError, ZstdError, struct.error, RuntimeError, MemoryError, OverflowError)


class RecordError(Exception):
    """The recording cannot be made or read; the message says which file and why."""


@dataclass(frozen=True, slots=True)
class AttachedFile:
    """A file carried inside the recording, such as the resolved configuration as JSON."""

    name: str
    media_type: str
    data: bytes


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


def is_mcap(stream: IO[bytes]) -> bool:
    """Whether a seekable stream begins as MCAP does; it is left at its start."""
    stream.seek(0)
    begins = stream.read(len(_MAGIC)) == _MAGIC
    stream.seek(0)
    return begins


def _check_magic(stream: IO[bytes]) -> None:
    if stream.read(len(_MAGIC)) != _MAGIC:
        raise RecordError(f"{getattr(stream, 'name', 'the stream')} is not an MCAP file")


def _records(stream: IO[bytes]) -> Iterator[McapRecord]:
    channels: set[int] = set()
    while len(head := stream.read(_RECORD_HEAD.size)) == _RECORD_HEAD.size:
        opcode, length = _RECORD_HEAD.unpack(head)
        if opcode in (Opcode.DATA_END, Opcode.FOOTER):
            return
        data = stream.read(min(length, _MAX_RECORD_BYTES))
        if len(data) < length:
            return
        try:
            records = _parse(opcode, data)
        except _DAMAGE:
            continue
        channels |= {record.id for record in records if isinstance(record, Channel)}
        # A message without its channel is another record whose opcode was damaged.
        yield from (r for r in records if not isinstance(r, Message) or r.channel_id in channels)


def _parse(opcode: int, data: bytes) -> list[McapRecord]:
    stream = ReadDataStream(io.BytesIO(data))
    if opcode == Opcode.CHUNK:
        return breakup_chunk(Chunk.read(stream), validate_crc=True)
    if opcode == Opcode.MESSAGE:
        return [Message.read(stream, len(data))]
    return [_READ[opcode](stream)] if opcode in _READ else []

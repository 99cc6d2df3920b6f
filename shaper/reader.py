"""What comes of a topic, turned back into what the local bus expects."""

from __future__ import annotations

from dataclasses import dataclass

from messages.payload import Payload, PayloadError, StreamEncoding, StreamReader, TopicEncoding
from shaper.wire_type import Encodings, split_wire_type


@dataclass(frozen=True, slots=True)
class Reader:
    """How one topic is read. digest: "" where messages cross as they are; bus_type: the publisher's."""

    digest: str
    bus_type: str
    encoding: TopicEncoding | None
    stream: StreamReader | None = None  # in the place of `encoding`, where messages refer to others

    def read(self, data: bytes, max_bytes: int, capture_unix_ns: int | None) -> Payload:
        """The payload for the bus. Raises PayloadError."""
        if not self.digest:
            return Payload(data, self.bus_type)
        if self.encoding is None:
            raise PayloadError(
                f"the peer sends it in an encoding with digest {self.digest}, which no table in [encodings] "
                "has here: both sides need the same schema or dictionary"
            )
        return self.encoding.decode(data, self.bus_type, max_bytes, capture_unix_ns)

    def read_in_stream(
        self, data: bytes, number: int, max_bytes: int, capture_unix_ns: int | None
    ) -> Payload | PayloadError | None:
        """The payload of a message that others may refer to, or why it has none; None if none ever does."""
        if self.stream is None:
            return None
        try:
            return self.stream.decode(data, number, self.bus_type, max_bytes, capture_unix_ns)
        except PayloadError as error:
            return error


Streams = dict[tuple[str, str], StreamReader]  # by key and digest: a key's types share its numbers


def reader_of(key: str, wire_type: str, encodings: Encodings, streams: Streams) -> Reader:
    """By the type that the peer tells of a topic."""
    digest, bus_type = split_wire_type(wire_type)
    encoding = encodings.get(digest)
    stream = None
    if isinstance(encoding, StreamEncoding):
        stream = streams.get((key, digest)) or streams.setdefault((key, digest), encoding.reader())
    return Reader(digest, bus_type, encoding, stream)

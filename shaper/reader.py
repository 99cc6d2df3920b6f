"""What comes of a topic, turned back into what the local bus expects."""

from __future__ import annotations

from dataclasses import dataclass

from messages.payload import Payload, PayloadError, TopicEncoding
from shaper.wire_type import Encodings, split_wire_type


@dataclass(frozen=True, slots=True)
class Reader:
    """How one topic is read. digest: "" where messages cross as they are; bus_type: the publisher's."""

    digest: str
    bus_type: str
    encoding: TopicEncoding | None

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


def reader_of(wire_type: str, encodings: Encodings) -> Reader:
    """By the type that the peer tells of a topic."""
    digest, bus_type = split_wire_type(wire_type)
    return Reader(digest, bus_type, encodings.get(digest))

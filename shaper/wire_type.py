"""How a topic's name on the link tells that its messages are encoded, and how.

A name holds the payloads' type as the bus has it ("application/cdr;sensor_msgs/msg/Imu"). Of a topic
with an encoding it is "straitlink/" + the encoding's digest + ";" + that type: the receiver looks the
digest up among its own encodings, so two sides whose schemas or dictionaries differ notice at once.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from messages.payload import TopicEncoding, digest_of
from messages.payload.topic_encoding import DIGEST_BYTES

_PREFIX = "straitlink/"
WIRE_TYPE_BYTES = len(_PREFIX) + 2 * DIGEST_BYTES + 1  # what an encoding adds to a topic's name

Encodings = Mapping[str, TopicEncoding]  # by digest


def by_digest(encodings: Iterable[TopicEncoding]) -> Encodings:
    """The encodings that this side can read."""
    return {digest_of(encoding): encoding for encoding in encodings}


def wire_type(encoding: TopicEncoding | None, bus_type: str) -> str:
    """The type to tell the peer."""
    return bus_type if encoding is None else f"{_PREFIX}{digest_of(encoding)};{bus_type}"


def split_wire_type(text: str) -> tuple[str, str]:
    """(digest, bus type); the digest is "" where messages cross as they are. Total on any string."""
    if not text.startswith(_PREFIX):
        return "", text
    digest, _, bus_type = text.removeprefix(_PREFIX).partition(";")
    return digest, bus_type

"""Protobuf payloads of the bus, read with the error that the seam expects."""

from __future__ import annotations

from typing import TypeVar

from google.protobuf.message import DecodeError as ProtobufDecodeError
from google.protobuf.message import Message
from google.protobuf.timestamp_pb2 import Timestamp

from messages.payload.topic_encoding import PayloadError

M = TypeVar("M", bound=Message)

_NS_PER_S = 1_000_000_000


def protobuf(message_type: type[Message]) -> str:
    """Zenoh's encoding string of a protobuf type."""
    return f"application/protobuf;{message_type.DESCRIPTOR.full_name}"


def parse(message_type: type[M], payload: bytes) -> M:
    """A message of the type. Raises PayloadError."""
    try:
        return message_type.FromString(payload)
    except ProtobufDecodeError as error:
        name = message_type.DESCRIPTOR.full_name
        raise PayloadError(f"a payload of {len(payload)} bytes is no {name}: {error}") from error


def stamp_ns(timestamp: Timestamp) -> int:
    """Ns since the Unix epoch."""
    return timestamp.seconds * _NS_PER_S + timestamp.nanos


def timestamp(unix_ns: int) -> Timestamp:
    """A protobuf time."""
    seconds, nanos = divmod(unix_ns, _NS_PER_S)
    return Timestamp(seconds=seconds, nanos=nanos)

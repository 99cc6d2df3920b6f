"""Payloads that cross as bounded messages (DCCL): each field as one of the values between its bounds."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Literal, Protocol

from google.protobuf.message import DecodeError as ProtobufDecodeError
from google.protobuf.message import Message

from messages.dccl import Codec, DcclError, Deviation
from messages.dccl.options import as_descriptor
from messages.payload.topic_encoding import Encoded, Payload, PayloadError

PROTOBUF = "application/protobuf"
OutOfRange = Literal["raise", "clamp"]


class PayloadMap(Protocol):
    """A payload type of the bus and a bounded message that says the same."""

    @property
    def bus_type(self) -> str:
        """Zenoh's encoding string of the payloads."""

    @property
    def description(self) -> str:
        """What both sides must agree on beyond the schema."""

    def to_message(self, payload: bytes) -> Message:
        """The bounded message. Raises PayloadError for a payload that is none of the type, or says more."""

    def to_payload(self, message: Message, capture_unix_ns: int | None) -> bytes:
        """A valid payload. capture_unix_ns: stands in for a time stamp that the message does not carry."""


class SameMessage:
    """The bounded message itself is on the bus, as protobuf."""

    description = "itself"

    def __init__(self, message_type: type[Message]) -> None:
        self._message_type = message_type
        stamp = as_descriptor(message_type).fields_by_name.get("capture_ns")
        self._has_capture_ns = stamp is not None and stamp.has_presence
        self.bus_type = f"{PROTOBUF};{message_type.DESCRIPTOR.full_name}"

    def to_message(self, payload: bytes) -> Message:
        """The payload parsed."""
        try:
            return self._message_type.FromString(payload)
        except ProtobufDecodeError as error:
            raise PayloadError(
                f"a payload is no {self._message_type.DESCRIPTOR.full_name}: {error}"
            ) from error

    def to_payload(self, message: Message, capture_unix_ns: int | None) -> bytes:
        """The message serialised; its `capture_ns`, which need not cross, is the link's."""
        if self._has_capture_ns and capture_unix_ns is not None and not message.HasField("capture_ns"):
            message.capture_ns = max(0, capture_unix_ns)  # type: ignore[attr-defined]
        return message.SerializePartialToString()


class BoundedEncoding:
    """One bounded message type, and the payload types of the bus that can be said in it.

    maps: beside the message itself. out_of_range: what becomes of a number beyond its bounds: the whole
    message is refused ("raise"), or the nearest bound is sent and told ("clamp").
    assume: the payloads' type where a publisher does not tell it (zenoh-plugin-ros2dds does not).
    publish: the type that this side's bus gets, where it is not the publisher's.
    Raises DcclError for a schema that DCCL refuses, PayloadError for a type that has no map.
    """

    def __init__(
        self,
        message_type: type[Message],
        maps: Iterable[PayloadMap] = (),
        *,
        out_of_range: OutOfRange = "raise",
        assume: str = "",
        publish: str = "",
    ) -> None:
        self.codec = Codec(message_type, out_of_range=out_of_range)
        self._maps = {m.bus_type: m for m in (SameMessage(message_type), *maps)}
        name = message_type.DESCRIPTOR.full_name
        agreed = sorted({m.description for m in self._maps.values()})
        self.description = f"DCCL {name} schema {self.codec.schema_hash:x} maps {agreed}"
        self._assume = ""  # while its own name is looked up
        self._assume = self._known(assume) if assume else ""
        self._publish = self._known(publish) if publish else ""

    def encode(self, payload: Payload) -> Encoded:
        """The payload as a bounded message."""
        message = self.to_message(payload)
        try:
            encoded = self.codec.encode_checked(message)
        except DcclError as error:
            raise PayloadError(str(error)) from error
        return Encoded(encoded.data, self.altered(encoded.deviations))

    def decode(self, data: bytes, bus_type: str, max_bytes: int, capture_unix_ns: int | None) -> Payload:
        """The payload in the type that this side's bus expects."""
        try:
            message = self.codec.decode(data, capture_unix_ns)
        except DcclError as error:
            raise PayloadError(str(error)) from error
        return self.to_payload(message, bus_type, max_bytes, capture_unix_ns)

    def to_message(self, payload: Payload) -> Message:
        """The bounded message that says what a payload does. Raises PayloadError."""
        return self._map_of(payload.type).to_message(payload.data)

    def altered(self, deviations: Sequence[Deviation]) -> str:
        """What in a message is not as its publisher had it."""
        return "; ".join(f"{d.path} = {d.value} {d.what}" for d in deviations[:3])

    def to_payload(
        self, message: Message, bus_type: str, max_bytes: int, capture_unix_ns: int | None
    ) -> Payload:
        """The payload that says what a bounded message does. Raises PayloadError."""
        wanted = self._known(self._publish or bus_type)
        payload = self._maps[wanted].to_payload(message, capture_unix_ns)
        if len(payload) > max_bytes:
            raise PayloadError(f"a payload of {len(payload)} bytes is beyond {max_bytes}")
        return Payload(payload, bus_type if wanted == canonical(bus_type) else wanted)

    def _map_of(self, bus_type: str) -> PayloadMap:
        return self._maps[self._known(bus_type)]

    def _known(self, bus_type: str) -> str:
        """The type as the maps name it, or what is assumed where it says nothing. Raises PayloadError."""
        found = canonical(bus_type)
        if found in self._maps:
            return found
        if ";" not in bus_type and self._assume:
            return self._assume
        name = self.codec.message_type.DESCRIPTOR.full_name
        raise PayloadError(
            f"payloads of type {bus_type!r} cannot be said as {name}; it takes {', '.join(self._maps)}"
        )


def canonical(bus_type: str) -> str:
    """ROS 2 types with their middle part: "sensor_msgs/JointState" is "sensor_msgs/msg/JointState"."""
    media, separator, name = bus_type.partition(";")
    package, slash, short = name.partition("/")
    if slash and "/" not in short:
        name = f"{package}/msg/{short}"
    return f"{media}{separator}{name}"

"""A map between a payload type and a bounded message, by way of a plain value that both can say."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from google.protobuf.message import Message

V = TypeVar("V")

Reader = Callable[[bytes], V]
Writer = Callable[[V], bytes]
Forms = Mapping[str, tuple[Reader[V], Writer[V]]]
"""How the bus says a value: (reader, writer) by Zenoh's encoding string. Readers raise PayloadError."""


@dataclass(frozen=True, slots=True)
class ValueMap(Generic[V]):
    """One of the bus's forms of a value. Both functions of the message may raise PayloadError.

    value_of takes the message and the link's capture time (ns since the Unix epoch, or None).
    """

    bus_type: str
    description: str
    read: Reader[V]
    write: Writer[V]
    message_of: Callable[[V], Message]
    value_of: Callable[[Any, int | None], V]

    def to_message(self, payload: bytes) -> Message:
        """The bounded message that says what the payload says."""
        return self.message_of(self.read(payload))

    def to_payload(self, message: Message, capture_unix_ns: int | None) -> bytes:
        """The payload that says what the bounded message says."""
        return self.write(self.value_of(message, capture_unix_ns))


def maps_of_forms(
    forms: Forms[V],
    description: str,
    message_of: Callable[[V], Message],
    value_of: Callable[[Any, int | None], V],
) -> tuple[ValueMap[V], ...]:
    """A map for each form."""
    return tuple(
        ValueMap(bus_type, description, read, write, message_of, value_of)
        for bus_type, (read, write) in forms.items()
    )

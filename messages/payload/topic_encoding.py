"""The seam: how a topic's payloads cross the link in another form than the one they have on the bus."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

DIGEST_BYTES = 8


class PayloadError(Exception):
    """A payload that its topic's encoding cannot carry or read; names message, field, value and bound."""


@dataclass(frozen=True, slots=True)
class Payload:
    """A message as a bus has it. type: Zenoh's encoding string, "application/cdr;sensor_msgs/msg/Imu"."""

    data: bytes
    type: str


@dataclass(frozen=True, slots=True)
class Encoded:
    """A message as it crosses. altered: what in it is not as the publisher had it; "" if all is."""

    data: bytes
    altered: str = ""


class TopicEncoding(Protocol):
    """Turns payloads into something smaller on one side and back on the other. Holds no state of a topic.

    An encoding may serve several topics, and both directions. It is applied when a message leaves, not
    when it is offered: what a newer sample replaces is never encoded.
    """

    @property
    def description(self) -> str:
        """Everything on which both sides must agree, in one line; the digest is taken over it."""

    def encode(self, payload: Payload) -> Encoded:
        """The payload's bytes for the link. Raises PayloadError and nothing else."""

    def decode(self, data: bytes, bus_type: str, max_bytes: int, capture_unix_ns: int | None) -> Payload:
        """Undo `encode`. Raises PayloadError and nothing else, whatever the bytes.

        bus_type: what the publisher's payload was. max_bytes: what the result may take.
        capture_unix_ns: when it was captured, on the clock of the publisher's host; None if not known yet.
        """


class StreamWriter(Protocol):
    """One topic's sender: codes each message against those that the receiver is known to hold."""

    def encode(self, payload: Payload, number: int) -> Encoded:
        """The payload's bytes as message `number` of the topic. Raises PayloadError and nothing else.

        A number is coded again where its message was replaced by a newer one before it left.
        """

    def on_arrived(self, number: int) -> None:
        """The receiver has been handed this message."""

    def on_receiver_restarted(self) -> None:
        """The receiver has forgotten everything."""


class StreamReader(Protocol):
    """One topic's receiver. Is handed every message that arrives, also those that come too late to matter."""

    def decode(
        self, data: bytes, number: int, bus_type: str, max_bytes: int, capture_unix_ns: int | None
    ) -> Payload:
        """As TopicEncoding.decode. number: the sender's, up to a constant."""


@runtime_checkable
class StreamEncoding(TopicEncoding, Protocol):
    """An encoding that holds state for each topic: its messages refer to earlier ones that have arrived."""

    def writer(self) -> StreamWriter:
        """For one topic, on the side that sends."""

    def reader(self) -> StreamReader:
        """For one topic of one life of the peer, on the side that receives."""


def digest_of(encoding: TopicEncoding) -> str:
    """16 hexadecimal digits by which both sides know that they mean the same encoding."""
    return hashlib.sha256(encoding.description.encode()).hexdigest()[: 2 * DIGEST_BYTES]

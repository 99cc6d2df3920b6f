"""The seam: how a topic's payloads cross the link in another form than the one they have on the bus."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Protocol

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


def digest_of(encoding: TopicEncoding) -> str:
    """16 hexadecimal digits by which both sides know that they mean the same encoding."""
    return hashlib.sha256(encoding.description.encode()).hexdigest()[: 2 * DIGEST_BYTES]

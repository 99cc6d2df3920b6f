"""Bounded messages of a state stream: each as its difference to one that has arrived. See messages.delta."""

from __future__ import annotations

from collections.abc import Iterable

from google.protobuf.message import Message

from messages.dccl import DcclError
from messages.delta import DeltaDecoder, DeltaEncoder
from messages.payload.bounded import BoundedEncoding, OutOfRange, PayloadMap
from messages.payload.topic_encoding import Encoded, Payload, PayloadError

# The link authenticates what comes and knows of restarts: what is left to check is our own mistakes.
CHECK_BITS = 4


class DeltaEncoding(BoundedEncoding):
    """A bounded encoding whose topics are streams; each has a writer on one side and a reader on the other.

    Raises DcclError also for a schema of which no differences can be taken: text, lists of messages.
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
        super().__init__(message_type, maps, out_of_range=out_of_range, assume=assume, publish=publish)
        self.description += " delta 2"
        DeltaEncoder(self.codec)  # a schema that has no differences is found here

    def writer(self) -> DeltaWriter:
        """What a topic's sender keeps."""
        return DeltaWriter(self)

    def reader(self) -> DeltaReader:
        """What a topic's receiver keeps."""
        return DeltaReader(self)


class DeltaWriter:
    """The sender's half of one topic."""

    def __init__(self, encoding: DeltaEncoding) -> None:
        self._encoding = encoding
        self._deltas = DeltaEncoder(encoding.codec, check_bits=CHECK_BITS)

    def encode(self, payload: Payload, number: int) -> Encoded:
        """The payload as a bounded message against the newest that has arrived."""
        message = self._encoding.to_message(payload)
        try:
            encoded = self._deltas.encode_checked(message, number)
        except DcclError as error:
            raise PayloadError(str(error)) from error
        return Encoded(encoded.data, self._encoding.altered(encoded.deviations))

    def on_arrived(self, number: int) -> None:
        """The receiver holds this message."""
        self._deltas.on_acknowledged(number)

    def on_receiver_restarted(self) -> None:
        """It holds none."""
        self._deltas.reset()


class DeltaReader:
    """The receiver's half of one topic."""

    def __init__(self, encoding: DeltaEncoding) -> None:
        self._encoding = encoding
        self._deltas = DeltaDecoder(encoding.codec, check_bits=CHECK_BITS)

    def decode(
        self, data: bytes, number: int, bus_type: str, max_bytes: int, capture_unix_ns: int | None
    ) -> Payload:
        """The payload in the type that this side's bus expects."""
        try:
            message = self._deltas.decode(data, number, capture_unix_ns)
        except DcclError as error:
            raise PayloadError(str(error)) from error
        return self._encoding.to_payload(message, bus_type, max_bytes, capture_unix_ns)

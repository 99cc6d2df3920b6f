"""What a datagram can hold: the values behind the bytes, and the sizes that both ends count with."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

VERSION = 1
HEADER_BYTES = 11
IP_UDP_BYTES = 28  # IPv4 (20) and UDP (8) headers, charged to the link for every datagram
NUMBER_BITS = 24
STAMP_BITS = 32
EPOCH_BITS = 16
MESSAGE_NUMBER_BITS = 16
ARRIVED_BITS = 64
MAX_SHARES = 256  # source and repair together: the code works in GF(2^8)
MAX_BAND_BYTES = 32  # of a band's name in an estimate
SENT_COUNTERS, RECEIVED_COUNTERS = 10, 6  # in a row of a ledger frame


class Header(NamedTuple):
    """What every datagram starts with; see the lines at the top of shaper.datagram for the fields.

    promise: code (see shaper.promise) of how soon the sender's next datagram follows at the latest.
    """

    epoch: int
    number: int
    stamp_us: int
    elicits_report: bool
    promise: int = 255


@dataclass(frozen=True, slots=True)
class TopicName:
    """A topic written out: its key, the encoding of its payloads, and how long they are worth anything.

    ttl_ms: a message older than this is not delivered; 0 for no limit.
    """

    key: str
    encoding: str
    ttl_ms: int = 0


class MessageFrame(NamedTuple):
    """A whole message, a part of one from `offset`, or one of its shares.

    topic_id: the sender's short number for a topic.
    name: what the number stands for; present until the receiver has confirmed that it knows.
    age_us: capture to the datagram's send stamp, microseconds.
    total_bytes: size of the whole message; a part is shorter. -1 for a whole message.
    reliable: to be delivered once and in order; then `back` is how many numbers before this one the
    oldest is that may still come.
    shares_needed: above 0 for a share of an erasure code; `offset` is then its index.
    """

    topic_id: int
    number: int
    age_us: int
    data: bytes
    offset: int = 0
    total_bytes: int = -1
    name: TopicName | None = None
    latest: bool = False
    compressed: bool = False
    reliable: bool = False
    back: int = 0
    shares_needed: int = 0

    @property
    def is_whole(self) -> bool:
        return not self.shares_needed and (self.total_bytes < 0 or len(self.data) == self.total_bytes)


class ReportFrame(NamedTuple):
    """What the receiver met, in its own clock: the raw material of link estimation.

    epoch: the epoch of the reported sender; a restarted sender ignores reports on its former self.
    largest: low bits of the largest packet number that arrived; arrival_us: when.
    received: packets that arrived in all since the receiver knows this epoch, modulo 2^32.
    earlier: (numbers before the one above, microseconds of arrival before it), newest first.
    arrived: bit i tells whether packet (largest - 1 - i) has arrived; empty if the last ARRIVED_BITS all
    have. So a lost report hides nothing, and what is missing is told again and again.
    """

    epoch: int
    largest: int
    arrival_us: int
    received: int
    earlier: tuple[tuple[int, int], ...] = ()
    arrived: bytes = b""


@dataclass(frozen=True, slots=True)
class HelloFrame:
    """The sender's wall clock at this datagram's send stamp, nanoseconds since the Unix epoch."""

    unix_ns: int


@dataclass(frozen=True, slots=True)
class EstimateFrame:
    """What the sender takes its own direction for, so that people see both directions at either end.

    rate_bps: paced at, on the wire. queue_ms: what the link is taken to hold. loss_ratio, confidence: 0 to 1,
    in steps of 1/255. holding: little leaves. band: at most MAX_BAND_BYTES of UTF-8; None: as told before.
    """

    rate_bps: int
    queue_ms: int
    loss_ratio: float
    confidence: float
    holding: bool = False
    band: str | None = None


@dataclass(frozen=True, slots=True)
class PaddingFrame:
    """Bytes that say nothing: a datagram that is sent to be timed needs a size."""

    padding_bytes: int


@dataclass(frozen=True, slots=True)
class KnownFrame:
    """Topic ids of the peer's epoch that the sender of this frame can name by now."""

    epoch: int
    topic_ids: tuple[int, ...]


class Outcome(IntEnum):
    """What the receiver did with a reliable message."""

    DELIVERED = 0
    EXPIRED = 1  # it came, but after its time to live
    UNREADABLE = 2  # it came in time, but the receiver cannot read its encoding
    UNCERTAIN = 3  # the receiver was killed while it handed it over


@dataclass(frozen=True, slots=True)
class ReceiptFrame:
    """What became of reliable messages: (topic id of the peer's epoch, message number, outcome)."""

    epoch: int
    receipts: tuple[tuple[int, int, Outcome], ...]


@dataclass(frozen=True, slots=True)
class SkipFrame:
    """Reliable messages of a topic before this number will not come any more. name: as in a message."""

    topic_id: int
    number: int
    name: TopicName | None = None


@dataclass(frozen=True, slots=True)
class LedgerFrame:
    """Counters since the start, by topic id: of the sender of this frame for its own topics (`sent_half`),
    or of what it received, by the ids of the peer's epoch."""

    epoch: int
    sent_half: bool
    rows: tuple[tuple[int, tuple[int, ...]], ...]


Frame = (
    MessageFrame
    | ReportFrame
    | HelloFrame
    | EstimateFrame
    | PaddingFrame
    | KnownFrame
    | ReceiptFrame
    | SkipFrame
    | LedgerFrame
)

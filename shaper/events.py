"""What the endpoint tells its driver. Drivers publish, trace and count; the core logs nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

from shaper.notices import Notice
from shaper.operator_lost import OperatorBack, OperatorLost

FOREVER_NS = 1 << 62


@dataclass(frozen=True, slots=True)
class Delivered:
    """A message from the peer, ready for the local bus.

    number: the message's number within its topic, in the peer's epoch.
    capture_unix_ns: capture time on the peer's wall clock; None until the peer has told its clock.
    one_way_delay_ns: first departure to complete arrival; age_ns: capture to complete arrival. Both
    by the offset between the two clocks as estimated from the exchange; None before the first estimate.
    left_ns: of its time to live; a very long time where there is no limit.
    on_handed_over: to be called when the local bus has the message, where that is journaled.
    """

    key: str
    payload: bytes
    encoding: str
    number: int
    capture_unix_ns: int | None
    one_way_delay_ns: int | None
    age_ns: int | None
    left_ns: int = FOREVER_NS
    on_handed_over: Callable[[], None] | None = field(default=None, compare=False, repr=False)


class ReceiptStage(StrEnum):
    """How far a message has come that is reliable, or that was asked for."""

    QUEUED = "queued"
    SENT = "sent"
    DELIVERED = "delivered"
    EXPIRED = "expired"  # its time to live ended, here or on arrival: it was not delivered
    # An answer that was asked for, of which too little arrived and nothing is repeated; or a message that
    # had not left when this side was killed, or that the other side was handing over when it was.
    LOST = "lost"
    SHED = "shed"  # it gave way in a full queue
    REFUSED = "refused"  # its topic's encoding cannot carry it
    UNREADABLE = "unreadable"  # it arrived, but the receiver cannot read its encoding


@dataclass(frozen=True, slots=True)
class Receipt:
    """News of a message that is reliable, or that was asked for. tag: what the driver gave with the offer.

    on_told: called by `pump_link` when the driver has taken it, where that is journaled.
    """

    key: str
    tag: int
    stage: ReceiptStage
    on_told: Callable[[], None] | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Wanted:
    """There is room for the newest item of a pull topic, of at most budget_bytes: ask for it."""

    key: str
    budget_bytes: int


@dataclass(frozen=True, slots=True)
class EncodingTrouble:
    """A topic's encoding and its payloads do not agree; told once in ten seconds for a topic at most.

    what: "refused" (a payload that cannot be encoded was dropped), "altered" (it was sent, but changed),
    or "unreadable" (one from the peer was dropped). reason: the newest, naming field and bound. count: how
    many messages it befell since it was last told.
    """

    key: str
    what: Literal["refused", "altered", "unreadable"]
    reason: str
    count: int


@dataclass(frozen=True, slots=True)
class PeerStarted:
    """The peer was heard for the first time, or has restarted (`again`)."""

    epoch: int
    again: bool


@dataclass(frozen=True, slots=True)
class PeerEstimate:
    """What the peer takes its sending direction for, which is the one that we receive by, as it told.

    Fields as in LinkState. band: empty while it has not been told. told_ns: when that came, by our clock.
    """

    rate_bps: int
    band: str
    loss_ratio: float
    holding: bool
    queue_ns: int
    confidence: float
    told_ns: int


@dataclass(frozen=True, slots=True)
class LinkState:
    """What this side believes of its own sending direction.

    rate_bps: paced at, on the wire. band: name of the recognised band.
    rtt_ns: newest round-trip time without the peer's holding time; None before the first report.
    loss_ratio: of the packets reported on lately. holding: only classes with always_send may leave.
    queue_ns: how long the link is taken to need for what it holds. confidence: 0 (blind) to 1 (measured and
    steady). receiving: the other direction; None while the peer has not told of it lately.
    """

    rate_bps: int
    band: str
    rtt_ns: int | None
    in_flight_bytes: int
    in_flight_limit_bytes: int
    loss_ratio: float
    holding: bool
    queue_ns: int = 0
    confidence: float = 1.0
    receiving: PeerEstimate | None = None


Event = (
    Delivered
    | Receipt
    | Wanted
    | EncodingTrouble
    | PeerStarted
    | LinkState
    | Notice
    | OperatorLost
    | OperatorBack
)

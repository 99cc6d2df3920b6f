"""What became of each message, per topic: the sender's half and the receiver's half."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import asdict, dataclass, field

AGE_BOUNDS_MS = (20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000, 30_000)
"""Upper bounds of the age histogram's buckets; one more bucket holds what is older."""


@dataclass(slots=True)
class SentLedger:
    """Counters of one topic where it enters the link.

    Every offered message ends in exactly one of decimated, superseded, expired, overflow (shed by a
    full queue), refused (its topic's encoding cannot carry it), lost_at_restart or sent, or waits:
    offered == decimated + superseded + expired + overflow + refused + lost_at_restart + sent + queued.
    lost_at_restart: reliable messages that had not begun to leave when this side was killed, or that the
    other side was handing over when it was killed.
    A reliable message counts as sent when the receiver has said that it delivered it, others when their
    last byte has left. sent_bytes: message bytes that left, as packed, of messages given up on the way
    too, without repetitions and parity; repeated_bytes: both of these. altered: messages that the
    encoding changed to carry them (a value clamped to its bound); they count on like any other, here only.
    """

    offered: int = 0
    decimated: int = 0
    superseded: int = 0
    expired: int = 0
    overflow: int = 0
    sent: int = 0
    sent_bytes: int = 0
    repeated_bytes: int = 0
    refused: int = 0
    lost_at_restart: int = 0
    altered: int = 0

    @property
    def queued(self) -> int:
        settled = self.decimated + self.superseded + self.expired + self.overflow + self.refused
        return self.offered - settled - self.lost_at_restart - self.sent

    def as_dict(self) -> dict[str, int]:
        return asdict(self)

    def counters(self) -> tuple[int, ...]:
        """All of them, as they cross the link."""
        return (
            self.offered,
            self.decimated,
            self.superseded,
            self.expired,
            self.overflow,
            self.sent,
            self.sent_bytes,
            self.repeated_bytes,
            self.refused,
            self.lost_at_restart,
        )


@dataclass(slots=True)
class ReceivedLedger:
    """Counters of one topic where it leaves the link.

    lost: message numbers that were passed over by later ones and have not come.
    stale: samples of a `latest` topic that a newer one had overtaken on the way.
    expired: messages that came whole, but after their time to live: not delivered.
    unreadable: messages that came in time, but in an encoding that this side lacks or that does not fit.
    ages: histogram of the ages at delivery, by AGE_BOUNDS_MS.
    """

    delivered: int = 0
    lost: int = 0
    stale: int = 0
    expired: int = 0
    received_bytes: int = 0
    unreadable: int = 0
    ages: list[int] = field(default_factory=lambda: [0] * (len(AGE_BOUNDS_MS) + 1))

    def on_delivered(self, received_bytes: int, age_ns: int | None) -> None:
        """A message goes to the bus. age_ns: None while the clocks are not told apart."""
        self.delivered += 1
        self.received_bytes += received_bytes
        if age_ns is not None:
            self.ages[bisect_left(AGE_BOUNDS_MS, age_ns // 1_000_000)] += 1

    def as_dict(self) -> dict[str, object]:
        return asdict(self)

    def counters(self) -> tuple[int, ...]:
        """Those that cross the link."""
        return (
            self.delivered,
            self.lost,
            self.stale,
            self.expired,
            self.received_bytes,
            self.unreadable,
        )

"""What became of each message, per topic: the sender's half and the receiver's half."""

from __future__ import annotations

from dataclasses import asdict, dataclass


@dataclass(slots=True)
class SentLedger:
    """Counters of one topic where it enters the link.

    Every offered message ends in exactly one of decimated, superseded, expired, overflow or sent, or
    waits: offered == decimated + superseded + expired + overflow + sent + queued.
    sent_bytes: payload bytes that left, as packed, parts of messages given up on the way included.
    """

    offered: int = 0
    decimated: int = 0
    superseded: int = 0
    expired: int = 0
    overflow: int = 0
    sent: int = 0
    sent_bytes: int = 0

    @property
    def queued(self) -> int:
        settled = self.decimated + self.superseded + self.expired + self.overflow + self.sent
        return self.offered - settled

    def as_dict(self) -> dict[str, int]:
        return asdict(self)


@dataclass(slots=True)
class ReceivedLedger:
    """Counters of one topic where it leaves the link.

    lost: message numbers that were passed over by later ones and have not come.
    stale: samples of a `latest` topic that a newer one had overtaken on the way.
    """

    delivered: int = 0
    lost: int = 0
    stale: int = 0
    received_bytes: int = 0

    def as_dict(self) -> dict[str, int]:
        return asdict(self)

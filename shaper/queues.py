"""What waits to leave: one queue per key, and the message that is leaving from it."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Protocol

from shaper.ledger import SentLedger
from shaper.traffic_class import Keep, TopicRule


class Payload(Protocol):
    """Bytes, or what the bus hands over; copied out only when the message leaves."""

    def __len__(self) -> int: ...
    def __bytes__(self) -> bytes: ...


@dataclass(slots=True)
class Waiting:
    """A message as it was offered, neither copied nor encoded."""

    payload: Payload
    encoding: str
    capture_ns: int


@dataclass(slots=True)
class Departure:
    """A message on its way out: packed, numbered, sent up to `offset`."""

    data: bytes
    encoding: str
    capture_ns: int
    number: int
    compressed: bool
    offset: int = 0

    @property
    def remaining_bytes(self) -> int:
        return len(self.data) - self.offset


class TopicQueue:
    """The messages of one key that wait for the link."""

    __slots__ = ("_next_ns", "active", "departing", "key", "ledger", "next_number", "rule", "waiting")

    def __init__(self, key: str, rule: TopicRule) -> None:
        self.key = key
        self.rule = rule
        self.ledger = SentLedger()
        self.waiting: deque[Waiting] = deque()
        self.departing: Departure | None = None
        self.active = False  # whether the scheduler has it in a tier
        self.next_number = 0
        self._next_ns = -(1 << 62)  # decimation: when the next sample is due

    def offer(self, payload: Payload, encoding: str, capture_ns: int, now_ns: int) -> bool:
        """Take or drop a message; True if one more waits than before.

        While a `latest` sample waits, a newer one replaces it whatever the decimation says: the slot
        is paid for already, and what leaves is then as fresh as can be.
        """
        ledger = self.ledger
        ledger.offered += 1
        latest = self.rule.traffic_class.keep is Keep.LATEST
        if latest and self.waiting:
            ledger.superseded += 1
            self.waiting[0] = Waiting(payload, encoding, capture_ns)
            return False
        period_ns = self.rule.min_period_ns
        if period_ns:
            # Half a period early is in time: a source at just the asked rate, with jitter, loses none.
            if now_ns < self._next_ns - period_ns // 2:
                ledger.decimated += 1
                return False
            self._next_ns = max(self._next_ns, now_ns) + period_ns
        self.waiting.append(Waiting(payload, encoding, capture_ns))
        if len(self.waiting) > self.rule.traffic_class.depth:
            self.waiting.popleft()
            ledger.overflow += 1
        return True

    def take(self, now_ns: int) -> Waiting | None:
        """The next message that is still worth sending; the expired ones before it are dropped."""
        ttl_ns = self.rule.traffic_class.ttl_ns
        while self.waiting:
            message = self.waiting.popleft()
            if now_ns - message.capture_ns <= ttl_ns:
                return message
            self.ledger.expired += 1
        return None

    def expire_departing(self) -> None:
        """Give up the message on its way out."""
        self.departing = None
        self.ledger.expired += 1

    @property
    def empty(self) -> bool:
        return not self.waiting and self.departing is None

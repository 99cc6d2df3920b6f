"""What waits to leave: one queue per key, and the message that is leaving from it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from messages.payload import Encoded, PayloadError
from messages.payload import Payload as BusPayload
from shaper.compression import pack
from shaper.events import Event
from shaper.ledger import SentLedger
from shaper.parity import Protected
from shaper.path import Content
from shaper.traffic_class import Keep, TopicRule
from shaper.trouble import TroubleTeller, What
from shaper.wire_type import wire_type


class Payload(Protocol):
    """Bytes, or what the bus hands over; copied out only when the message leaves."""

    def __len__(self) -> int: ...
    def __bytes__(self) -> bytes: ...


@dataclass(slots=True)
class Waiting:
    """A message as it was offered, neither copied nor encoded. tag: the publisher's own number for it."""

    payload: Payload
    encoding: str
    capture_ns: int
    tag: int = 0


@dataclass(slots=True)
class Departure:
    """A message on its way out: packed, numbered, sent up to `offset`.

    protected: the message under an erasure code; None where it leaves in plain parts.
    """

    data: bytes
    encoding: str
    capture_ns: int
    number: int
    compressed: bool
    tag: int = 0
    offset: int = 0
    protected: Protected | None = None

    @property
    def begun(self) -> bool:
        return self.offset > 0 or (self.protected is not None and self.protected.sent > 0)

    @property
    def shares_needed(self) -> int:
        """Of a message under an erasure code; 0 of another."""
        return 0 if self.protected is None else self.protected.needed

    @property
    def remaining_bytes(self) -> int:
        """Of the message, without parity."""
        return len(self.data) - self.offset if self.protected is None else self.protected.source_bytes_left

    def has_left(self, loss_ratio: float) -> bool:
        """Whether nothing more of it is worth sending."""
        if self.protected is None:
            return self.offset == len(self.data)
        return self.protected.enough(loss_ratio)


class Piece(NamedTuple):
    """What a queue would send next: `length` bytes of a message from `offset`.

    again: not for the first time.
    """

    departure: Departure
    offset: int
    length: int
    again: bool = False


class TopicQueue:
    """The messages of one key that wait for the link."""

    __slots__ = (
        "_next_ns",
        "_tell",
        "_trouble",
        "active",
        "departing",
        "key",
        "ledger",
        "next_number",
        "rule",
        "virtual_finish",
        "waiting",
        "wake",
    )

    def __init__(
        self,
        key: str,
        rule: TopicRule,
        wake: Callable[[TopicQueue], None] = lambda queue: None,
        tell: Callable[[Event], None] = lambda event: None,
    ) -> None:
        self.key = key
        self.rule = rule
        self.ledger = SentLedger()
        self.waiting: deque[Waiting] = deque()
        self.departing: Departure | None = None
        self.active = False  # whether the scheduler has it in a tier
        self.virtual_finish = 0  # the scheduler's: where this topic stands among its tier's
        self.wake = wake  # puts the queue in line when it has got something to send by itself
        self.next_number = 0
        self._tell = tell  # takes what the driver shall hear
        self._trouble = TroubleTeller(key)
        self._next_ns = -(1 << 62)  # decimation: when the next sample is due

    def offer(self, payload: Payload, encoding: str, capture_ns: int, now_ns: int, tag: int = 0) -> bool:
        """Take or drop a message; True if one more waits than before.

        While a `latest` sample waits, a newer one replaces it whatever the decimation says: the slot
        is paid for already, and what leaves is then as fresh as can be.
        """
        ledger = self.ledger
        ledger.offered += 1
        if self.waiting and self.rule.traffic_class.keep is Keep.LATEST:
            ledger.superseded += 1
            self.waiting[0] = Waiting(payload, encoding, capture_ns, tag)
            return False
        if not self.due(now_ns):
            ledger.decimated += 1
            return False
        self.waiting.append(Waiting(payload, encoding, capture_ns, tag))
        if len(self.waiting) > self.rule.traffic_class.depth:
            self.overflowed(self.waiting.popleft())
        return True

    def due(self, now_ns: int) -> bool:
        """Whether decimation lets a sample through now; if so, that counts as the period's."""
        period_ns = self.rule.min_period_ns
        if period_ns:
            # Half a period early is in time: a source at just the asked rate, with jitter, loses none.
            if now_ns < self._next_ns - period_ns // 2:
                return False
            self._next_ns = max(self._next_ns, now_ns) + period_ns
        return True

    def overflowed(self, message: Waiting) -> None:
        """A message gives way because the queue is full."""
        self.ledger.overflow += 1

    def next_piece(self, now_ns: int) -> Piece | None:
        """What to send next; the expired messages before it are dropped."""
        departure = self.departing
        if departure is not None and not departure.begun and self._is_superseded():
            self.ledger.superseded += 1
            self.departing = departure = None
        departure = departure or self.depart(now_ns)
        if departure is None:
            return None
        return Piece(departure, departure.offset, len(departure.data) - departure.offset)

    def _is_superseded(self) -> bool:
        """Whether a newer sample waits while what departs is still all here."""
        return bool(self.waiting) and self.rule.traffic_class.keep is Keep.LATEST

    def depart(self, now_ns: int) -> Departure | None:
        """Take the next message that is still worth sending, pack and number it."""
        ttl_ns = self.rule.traffic_class.ttl_ns
        while self.waiting:
            message = self.waiting.popleft()
            if now_ns - message.capture_ns > ttl_ns:
                self.expired(message.tag)
                continue
            try:
                data, compressed = self._pack(message, now_ns)
            except PayloadError as error:
                self.refused(message.tag)
                self.trouble("refused", str(error), now_ns)
                continue
            name = wire_type(self.rule.encoding, message.encoding)
            self.departing = Departure(
                data, name, message.capture_ns, self.next_number, compressed, message.tag
            )
            return self.departing
        return None

    def _pack(self, message: Waiting, now_ns: int) -> tuple[bytes, bool]:
        if self.rule.encoding is None:
            return pack(bytes(message.payload), self.rule.compression)
        encoded = self._encode(message)
        if encoded.altered:
            self.ledger.altered += 1
            self.trouble("altered", encoded.altered, now_ns)
        return encoded.data, False

    def _encode(self, message: Waiting) -> Encoded:
        assert self.rule.encoding is not None  # the caller has looked
        return self.rule.encoding.encode(BusPayload(bytes(message.payload), message.encoding))

    def refused(self, tag: int) -> None:
        """The topic's encoding cannot carry a message."""
        self.ledger.refused += 1

    def trouble(self, what: What, reason: str, now_ns: int) -> None:
        """Say what befell a message, if it was not said lately."""
        event = self._trouble.note(what, reason, now_ns)
        if event is not None:
            self._tell(event)

    def expired(self, tag: int) -> None:
        """A message's time to live has ended on this side."""
        self.ledger.expired += 1

    def too_late(self, piece: Piece) -> None:
        """What departs cannot make its deadline: give it up."""
        self.departing = None
        self.expired(piece.departure.tag)

    def sent(self, piece: Piece, count: int, loss_ratio: float = 0.0) -> Content | None:
        """`count` bytes of the piece have left in a datagram; what wants to know of its fate.

        loss_ratio: of the link now, by which the parity of the rest is decided.
        """
        departure, protected = piece.departure, piece.departure.protected
        self.next_number = departure.number + 1
        is_parity = protected is not None and protected.sent >= protected.needed
        if protected is None:
            departure.offset += count
        else:
            protected.sent += 1
        if is_parity:
            self.ledger.repeated_bytes += count
        else:
            self.ledger.sent_bytes += count
        if departure.has_left(loss_ratio):
            self.departed()
        return None

    def departed(self) -> None:
        """The last byte of a message has left."""
        self.ledger.sent += 1
        self.departing = None

    def on_peer_restarted(self) -> None:
        """The peer has forgotten everything; a message on its way is begun anew."""
        departure = self.departing
        if departure is not None:
            departure.offset = 0
            departure.protected = None  # cut anew: shares must leave room for the topic's name again

    @property
    def empty(self) -> bool:
        """Whether there is nothing to send now."""
        return not self.waiting and self.departing is None

    @property
    def message_under_way(self) -> bool:
        """Whether a message has been begun that must not wait for its tier's other topics."""
        return self.departing is not None and self.departing.begun

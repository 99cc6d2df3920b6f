"""Messages that must arrive: repeated until the receiver's receipt, or reported expired.

A message that has left stays outstanding. What is lost of it (the path says so) leaves again before
anything new, charged like anything else. The receiver delivers once and in order and sends a receipt.
When a message's time to live ends, it is repeated no more and the receiver is told not to wait for it;
if any of it had left, only the receiver can say whether it came in time, and does.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from shaper.events import Event, Receipt, ReceiptStage
from shaper.frames import Outcome
from shaper.path import Content
from shaper.queues import Departure, Payload, Piece, TopicQueue, Waiting
from shaper.traffic_class import TopicRule

MAX_OUTSTANDING = 64  # messages of a topic under way at a time; also what a receiver may have to hold

_STAGES = {Outcome.DELIVERED: ReceiptStage.DELIVERED, Outcome.UNREADABLE: ReceiptStage.UNREADABLE}


@dataclass(frozen=True, slots=True)
class _SentPart:
    queue: ReliableQueue
    number: int
    offset: int
    count: int

    def on_arrived(self) -> None:
        """Nothing: only the receipt says that the whole message is there."""

    def on_lost(self) -> None:
        self.queue.repeat(self.number, self.offset, self.count)


@dataclass(frozen=True, slots=True)
class SentSkip:
    """A skip that is on its way."""

    queue: ReliableQueue

    def on_arrived(self) -> None:
        """The receiver waits no more."""

    def on_lost(self) -> None:
        self.queue.skip()


class ReliableQueue(TopicQueue):
    """A FIFO whose messages are kept until the peer has said what became of them."""

    __slots__ = ("_abandoned", "_again", "_skipped_to", "encoding", "outstanding", "skip_due")

    def __init__(
        self,
        key: str,
        rule: TopicRule,
        wake: Callable[[TopicQueue], None],
        tell: Callable[[Event], None],
    ) -> None:
        super().__init__(key, rule, wake, tell)
        self.outstanding: dict[int, Departure] = {}
        self._abandoned: dict[int, int] = {}  # number: tag; given up, the receiver's word is awaited
        self.skip_due = False  # the receiver has to be told that numbers will not come
        self._skipped_to = 0  # it was told that none before this will
        self.encoding = ""  # of the newest message
        self._again: deque[tuple[int, int, int]] = deque()  # (number, offset, count) to be repeated

    def offer(self, payload: Payload, encoding: str, capture_ns: int, now_ns: int, tag: int = 0) -> bool:
        waits = super().offer(payload, encoding, capture_ns, now_ns, tag)
        if waits:
            self._tell(Receipt(self.key, tag, ReceiptStage.QUEUED))
        return waits

    def overflowed(self, message: Waiting) -> None:
        super().overflowed(message)
        self._tell(Receipt(self.key, message.tag, ReceiptStage.SHED))

    def next_piece(self, now_ns: int) -> Piece | None:
        self._expire_outstanding(now_ns)
        while self._again:
            number, offset, count = self._again[0]
            departure = self.outstanding.get(number)
            if departure is not None:
                return Piece(departure, offset, count, again=True)
            self._again.popleft()
        if self.departing is None and self._window_full:
            return None
        return super().next_piece(now_ns)

    def depart(self, now_ns: int) -> Departure | None:
        departure = super().depart(now_ns)
        if departure is not None:
            self.outstanding[departure.number] = departure
            self.encoding = departure.encoding
        return departure

    def expired(self, tag: int) -> None:
        super().expired(tag)
        self._tell(Receipt(self.key, tag, ReceiptStage.EXPIRED))

    def refused(self, tag: int) -> None:
        super().refused(tag)
        self._tell(Receipt(self.key, tag, ReceiptStage.REFUSED))

    def too_late(self, piece: Piece) -> None:
        self._give_up(piece.departure)

    def sent(self, piece: Piece, count: int, loss_ratio: float = 0.0) -> Content | None:
        if piece.again:
            self._again.popleft()
            if count < piece.length:
                rest = (piece.departure.number, piece.offset + count, piece.length - count)
                self._again.appendleft(rest)
            self.ledger.repeated_bytes += count
        else:
            super().sent(piece, count, loss_ratio)
        return _SentPart(self, piece.departure.number, piece.offset, count)

    def departed(self) -> None:
        assert self.departing is not None
        self._tell(Receipt(self.key, self.departing.tag, ReceiptStage.SENT))
        self.departing = None

    def repeat(self, number: int, offset: int, count: int) -> None:
        """A part was lost; it leaves again unless the message is settled by now."""
        if number in self.outstanding:
            self._again.append((number, offset, count))
            self.wake(self)

    def skip(self) -> None:
        """Tell the receiver not to wait for numbers that were given up."""
        self.skip_due = True
        self.wake(self)

    def take_skip(self) -> int:
        """The number before which none will come."""
        self.skip_due = False
        self._skipped_to = self.first_outstanding()
        return self._skipped_to

    def first_outstanding(self) -> int:
        """The oldest number that may still come."""
        return next(iter(self.outstanding), self.next_number)

    def on_outcome(self, number_low_bits: int, outcome: Outcome) -> None:
        """The peer says what became of a message."""
        tag = self._settle(number_low_bits)
        if tag is None:
            return
        if outcome is Outcome.EXPIRED:
            self.expired(tag)
        elif outcome is Outcome.UNCERTAIN:
            self.lost(tag)
        else:
            self.ledger.sent += 1
            self._tell(Receipt(self.key, tag, _STAGES[outcome]))
        first = self.first_outstanding()
        if any(self._skipped_to <= number < first for number in self._abandoned):
            self.skip()  # some were given up behind this one
        if not self.empty:
            self.wake(self)  # the window has room again

    def on_peer_restarted(self) -> None:
        """Everything without a receipt leaves again, in order."""
        for tag in self._abandoned.values():
            self.expired(tag)  # nobody is left who could say otherwise
        self._abandoned.clear()
        self._close_gaps()
        self.on_peer_resumed()

    def on_peer_resumed(self) -> None:
        """The peer has started anew and remembers: everything leaves again under its old number."""
        if self.departing is not None:
            self.departing.offset = 0
        self._again = deque(
            (number, 0, len(departure.data))
            for number, departure in self.outstanding.items()
            if departure is not self.departing
        )
        self.skip_due = bool(self._abandoned)
        if not self.empty:
            self.wake(self)

    def abandon(self, number: int, tag: int) -> None:
        """Repeat a message no more, but wait for the receiver's word on it."""
        self._abandoned[number] = tag
        self.skip()

    def lost(self, tag: int) -> None:
        """A process was killed that had a message in its hands."""
        self.ledger.lost_at_restart += 1
        self._tell(Receipt(self.key, tag, ReceiptStage.LOST))

    def _close_gaps(self) -> None:
        """Number what is outstanding anew if some between were settled: the new peer would wait for them."""
        numbers = list(self.outstanding)
        if not numbers or numbers[-1] - numbers[0] == len(numbers) - 1:
            return
        start = max(self.next_number, numbers[-1] + 1)
        departures = list(self.outstanding.values())
        for number, departure in enumerate(departures, start):
            departure.number = number
        self.outstanding = {departure.number: departure for departure in departures}
        self.next_number = departures[-1].number + 1

    def _expire_outstanding(self, now_ns: int) -> None:
        ttl_ns = self.rule.traffic_class.ttl_ns
        late = [n for n, d in self.outstanding.items() if now_ns - d.capture_ns > ttl_ns]
        for number in late:
            self._give_up(self.outstanding[number])

    def _give_up(self, departure: Departure) -> None:
        del self.outstanding[departure.number]
        if self.departing is departure:
            self.departing = None
        if departure.begun:
            self.abandon(departure.number, departure.tag)
        else:
            self.expired(departure.tag)

    def _settle(self, number_low_bits: int) -> int | None:
        """Forget a message that the receiver has spoken of; its tag, or None if there is none."""
        for number, departure in self.outstanding.items():
            if number & 0xFFFF == number_low_bits:
                del self.outstanding[number]
                if self.departing is departure:  # cannot be, unless the peer is wrong
                    self.departing = None
                return departure.tag
        for number in self._abandoned:
            if number & 0xFFFF == number_low_bits:
                return self._abandoned.pop(number)
        return None

    @property
    def awaits_outcome(self) -> bool:
        """Whether the receiver has still to say what became of something."""
        return bool(self.outstanding or self._abandoned)

    @property
    def empty(self) -> bool:
        if self._again or self.skip_due or self.departing is not None:
            return False
        return not self.waiting or self._window_full

    @property
    def _window_full(self) -> bool:
        return len(self.outstanding) + len(self._abandoned) >= MAX_OUTSTANDING

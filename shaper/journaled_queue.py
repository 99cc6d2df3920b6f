"""A reliable topic whose messages outlive this process: on record before they are said to be queued."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial

from shaper.events import Event, Receipt, ReceiptStage
from shaper.journal import Journal, OwnMessage
from shaper.path import Content
from shaper.queues import Payload, Piece, TopicQueue, Waiting
from shaper.reliable import ReliableQueue
from shaper.traffic_class import TopicRule

_UNDER_WAY = frozenset({ReceiptStage.QUEUED, ReceiptStage.SENT})


class JournaledQueue(ReliableQueue):
    """A reliable queue that calls its messages by their serial numbers in the journal.

    What had begun to leave when the process was killed leaves again under its old number, so the receiver
    takes it once; what had not is lost, and said to be.
    """

    __slots__ = ("_journal", "_tags")

    def __init__(
        self,
        key: str,
        rule: TopicRule,
        wake: Callable[[TopicQueue], None],
        tell: Callable[[Event], None],
        journal: Journal,
    ) -> None:
        def tell_by_tag(event: Event) -> None:
            tell(self._by_tag(event) if isinstance(event, Receipt) else event)

        super().__init__(key, rule, wake, tell_by_tag)
        self._journal = journal
        self._tags: dict[int, int] = {}  # by serial number

    def offer(self, payload: Payload, encoding: str, capture_ns: int, now_ns: int, tag: int = 0) -> bool:
        raw = bytes(payload)
        serial = self._journal.accept(self.key, tag, capture_ns, encoding, raw)
        if serial is None:
            self.ledger.offered += 1
            self.ledger.overflow += 1
            self._tell(Receipt(self.key, -1 - tag, ReceiptStage.SHED))
            return False
        self._tags[serial] = tag
        waits = super().offer(raw, encoding, capture_ns, now_ns, serial)
        if not waits:  # decimated
            self._forget(serial)
        return waits

    def sent(self, piece: Piece, count: int, loss_ratio: float = 0.0) -> Content | None:
        if not piece.again and not piece.departure.begun:
            self._journal.depart(piece.departure.tag, self.key, piece.departure.number)
        return super().sent(piece, count, loss_ratio)

    def restore(self, messages: Iterable[OwnMessage], next_number: int, now_ns: int) -> None:
        """Take up what the former process left."""
        self.next_number = next_number
        for message in messages:
            self._tags[message.serial] = message.tag
            self.ledger.offered += 1
            if message.number is None:
                self.lost(message.serial)
            else:
                self._restore_departed(message, message.number, now_ns)
        if not self.empty:
            self.wake(self)

    def _restore_departed(self, message: OwnMessage, number: int, now_ns: int) -> None:
        if now_ns - message.capture_ns > self.rule.traffic_class.ttl_ns:
            self.abandon(number, message.serial)  # only the receiver can say whether it came in time
            return
        self.waiting.append(Waiting(message.payload, message.encoding, message.capture_ns, message.serial))
        departure = self.depart(now_ns)
        if departure is None:  # the topic's encoding is another now, and refuses it
            return
        del self.outstanding[departure.number]
        departure.number = number
        self.outstanding[number] = departure
        departure.offset = len(departure.data)
        self.departing = None
        self.repeat(number, 0, len(departure.data))

    def _close_gaps(self) -> None:
        super()._close_gaps()
        for number, departure in self.outstanding.items():
            if departure.begun:
                self._journal.depart(departure.tag, self.key, number)

    def _by_tag(self, receipt: Receipt) -> Receipt:
        """A receipt with the publisher's number in place of the journal's; the last one clears both."""
        serial = receipt.tag
        if serial < 0:  # was never on record
            return Receipt(receipt.key, -1 - serial, receipt.stage)
        done = None if receipt.stage in _UNDER_WAY else partial(self._forget, serial)
        return Receipt(receipt.key, self._tags[serial], receipt.stage, done)

    def _forget(self, serial: int) -> None:
        self._journal.settle(serial)
        self._tags.pop(serial, None)

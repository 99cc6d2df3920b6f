"""What must hold whatever happens: each reliable message once or reported, bounded memory, true ledgers."""

from __future__ import annotations

from dataclasses import dataclass, field

from shaper.events import Delivered, Receipt, ReceiptStage
from shaper.incoming import Limits
from shaper.journal import MemoryJournal
from shaper.link_end import LinkEnd

_UNDER_WAY = frozenset({ReceiptStage.QUEUED, ReceiptStage.SENT})
LIMITS = Limits(max_topics=64, max_message_bytes=100_000, max_reassembly_bytes=400_000)
MAX_JOURNAL_MESSAGES = 512


class BrokenInvariant(Exception):
    """Something happened that must not; a full sentence."""


@dataclass(slots=True)
class MessageFate:
    """One reliable message over the lives of both processes."""

    key: str
    deliveries: int = 0
    outcomes: list[ReceiptStage] = field(default_factory=list)


class Fates:
    """The reliable messages of one direction, by tag."""

    def __init__(self, direction: str) -> None:
        self.direction = direction
        self.fates: dict[int, MessageFate] = {}
        self._newest: dict[str, int] = {}

    def offered(self, key: str, tag: int) -> None:
        """A publisher has put a message."""
        self.fates[tag] = MessageFate(key)

    def delivered(self, event: Delivered) -> None:
        """It is on the other side's bus."""
        tag = int.from_bytes(event.payload[:8], "little")
        fate = self.fates.get(tag)
        if fate is None or fate.key != event.key:
            raise BrokenInvariant(f"{self.direction}: message {tag} on {event.key} was never put there")
        fate.deliveries += 1
        if fate.deliveries > 1:
            raise BrokenInvariant(f"{self.direction}: message {tag} on {event.key} was given twice")
        if tag < self._newest.get(event.key, -1):
            raise BrokenInvariant(f"{self.direction}: message {tag} on {event.key} came after a later one")
        self._newest[event.key] = tag

    def told(self, receipt: Receipt) -> None:
        """Its publisher is told what became of it."""
        fate = self.fates.get(receipt.tag)
        if receipt.stage in _UNDER_WAY or fate is None:
            return
        fate.outcomes.append(receipt.stage)
        if len(fate.outcomes) > 1:
            raise BrokenInvariant(f"{self.direction}: message {receipt.tag} has outcomes {fate.outcomes}")

    def check_end(self) -> None:
        """After the calm nothing is open, and what was told is true."""
        for tag, fate in self.fates.items():
            where = f"{self.direction}: message {tag} on {fate.key}"
            if not fate.outcomes:
                raise BrokenInvariant(f"{where}: nobody ever told what became of it")
            delivered = fate.outcomes[0] is ReceiptStage.DELIVERED
            # A process that was killed while it handed a message over cannot say more than that.
            if delivered != bool(fate.deliveries) and fate.outcomes[0] is not ReceiptStage.LOST:
                raise BrokenInvariant(f"{where}: told {fate.outcomes[0]}, given {fate.deliveries} times")


def check_bounds(link: LinkEnd, journal: MemoryJournal) -> None:
    """What this side holds of the other's, and of its own."""
    endpoint = link.endpoint
    held_bytes = endpoint.held_bytes
    if held_bytes > LIMITS.max_reassembly_bytes * 3:
        raise BrokenInvariant(f"{held_bytes} bytes are held, more than three budgets")
    sessions = len(link.channel.session_ids())
    if sessions > 3 + 8 + 16:
        raise BrokenInvariant(f"{sessions} sessions are held")
    if len(journal.own_messages()) > MAX_JOURNAL_MESSAGES:
        raise BrokenInvariant("the journal holds more than it may")
    for key, ledger in endpoint.sent_ledgers().items():
        if ledger.queued < 0:
            raise BrokenInvariant(f"the ledger of {key} is out of balance: {ledger}")

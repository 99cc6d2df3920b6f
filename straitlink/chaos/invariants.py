"""What must hold whatever happens: each reliable message once or reported, bounded memory, true ledgers."""

from __future__ import annotations

import gc
from collections import Counter, deque
from dataclasses import dataclass, field
from types import MethodType

from shaper.events import Delivered, Receipt, ReceiptStage
from shaper.incoming import Limits
from shaper.journal import MemoryJournal
from shaper.link_end import LinkEnd

_UNDER_WAY = frozenset({ReceiptStage.QUEUED, ReceiptStage.SENT})
LIMITS = Limits(max_topics=64, max_message_bytes=100_000, max_reassembly_bytes=400_000)
MAX_JOURNAL_MESSAGES = 512
MAX_ELEMENTS = 12_000  # of all containers of a side; 4,000 in the storm ...
MAX_ELEMENTS_IN_CALM = 1_600  # ... and 800 after it are usual, 1,200 with what the estimator looks back on
_LEDGER_OF_STAGE = {
    ReceiptStage.DELIVERED: "sent",
    ReceiptStage.EXPIRED: "expired",
    ReceiptStage.SHED: "overflow",
    ReceiptStage.REFUSED: "refused",
    ReceiptStage.LOST: "lost_at_restart",
}


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
        self._keys: set[str] = set()
        self._newest: dict[str, int] = {}
        self._samples: set[tuple[str, bytes]] = set()  # given by the receiver's present process
        self._told: Counter[tuple[str, ReceiptStage]] = Counter()  # by the present process

    def offered(self, key: str, tag: int) -> None:
        """A publisher has put a message."""
        self.fates[tag] = MessageFate(key)
        self._keys.add(key)

    def on_start(self) -> None:
        """The sender's process has started anew."""
        self._told.clear()

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

    def on_receiver_start(self) -> None:
        """The receiver's process has started anew: of samples it remembers nothing."""
        self._samples.clear()

    def sampled(self, event: Delivered) -> None:
        """A message that is sent once is on the other side's bus: whoever plays it back must not be heard."""
        sample = event.key, event.payload[:8]
        if sample in self._samples:
            raise BrokenInvariant(f"{self.direction}: a sample on {event.key} was given twice")
        self._samples.add(sample)

    def told(self, receipt: Receipt) -> None:
        """Its publisher is told what became of it."""
        fate = self.fates.get(receipt.tag)
        if receipt.stage in _UNDER_WAY or fate is None:
            return
        fate.outcomes.append(receipt.stage)
        self._told[receipt.key, receipt.stage] += 1
        if len(fate.outcomes) > 1:
            raise BrokenInvariant(f"{self.direction}: message {receipt.tag} has outcomes {fate.outcomes}")

    def check_ledgers(self, link: LinkEnd) -> None:
        """What the sender's ledgers count is what the publishers were told."""
        ledgers = link.endpoint.sent_ledgers()
        for key in self._keys & ledgers.keys():
            for stage, name in _LEDGER_OF_STAGE.items():
                counted, told = getattr(ledgers[key], name), self._told[key, stage]
                if counted != told:
                    raise BrokenInvariant(
                        f"{self.direction}: the ledger of {key} counts {counted} {name}, told were {told}"
                    )

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


def check_deliveries(link: LinkEnd, delivered: Counter[str]) -> None:
    """What the receiver's ledgers count is what came out. delivered: of the present process, by key."""
    for key, ledger in link.endpoint.received_ledgers.items():
        if ledger.delivered != delivered[key]:
            raise BrokenInvariant(
                f"the ledger of {key} counts {ledger.delivered} of {delivered[key]} deliveries"
            )


def check_elements(link: LinkEnd, most: int) -> None:
    """Whether anything grows, known or not: the elements of all containers that a side can reach."""
    elements = _held_elements(link)
    if elements > most:
        raise BrokenInvariant(f"{elements} elements are held, more than {most}")


def _held_elements(root: object) -> int:
    seen: set[int] = set()
    to_visit: list[object] = [root]
    elements = 0
    while to_visit:
        each = to_visit.pop()
        if id(each) in seen:
            continue
        seen.add(id(each))
        if isinstance(each, dict):
            elements += len(each)
            to_visit += [*each.keys(), *each.values()]
        elif isinstance(each, list | tuple | set | frozenset | deque):
            elements += 0 if hasattr(each, "_fields") else len(each)  # a NamedTuple is a record, no container
            to_visit += each
        elif isinstance(each, MethodType):
            to_visit.append(each.__self__)
        elif type(each).__module__.startswith("shaper."):
            to_visit += [part for part in gc.get_referents(each) if not isinstance(part, type)]
    return elements

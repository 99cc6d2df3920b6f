"""The peer's topics on our side: what has come of each, and what may be delivered now."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from messages.payload import Payload, PayloadError
from shaper.frames import MESSAGE_NUMBER_BITS, TopicName
from shaper.ledger import ReceivedLedger
from shaper.reader import Reader
from shaper.reliable import MAX_OUTSTANDING
from shaper.serial_number import ReceivedWindow, expand, expand_above
from shaper.shared_state import decode_entries
from shaper.trouble import TroubleTeller

_WINDOW = 256  # message numbers in which a late one is told from a new one


@dataclass(slots=True)
class Budget:
    """Memory that all topics of the peer share."""

    max_bytes: int
    held_bytes: int = 0

    def has_room(self, count: int) -> bool:
        """Whether so many bytes more may be held."""
        return self.held_bytes + count <= self.max_bytes


class Arrived(NamedTuple):
    """A whole message, with its capture and first send stamp in the peer's clock (us).

    topic_id: of the peer's epoch; number: low bits, as on the wire. packed_bytes: as it crossed.
    read: its payload for the bus, or why it has none, where that had to be known at once.
    """

    topic_id: int
    number: int
    payload: bytes
    packed_bytes: int
    capture_us: int
    first_sent_us: int
    read: Payload | PayloadError | None = None


class PlainInbox:
    """Messages that are sent once."""

    def __init__(self, ledger: ReceivedLedger) -> None:
        self._ledger = ledger
        self._highest = -1
        self._window = ReceivedWindow(span=_WINDOW)

    def full_number(self, low_bits: int) -> int:
        """A message's number, of which the wire has the low bits."""
        if self._highest < 0:
            return low_bits
        # A heartbeat wraps its 16 bits in two hours, and a blackout may last as long. Replays end at
        # the packet numbers, so what is older than the window here is a number come round again.
        return expand_above(low_bits, MESSAGE_NUMBER_BITS, self._highest - _WINDOW)

    def arrived(self, low_bits: int, latest: bool) -> int | None:
        """The message's full number; None if it has come before or is overtaken: not to be delivered."""
        if self._highest < 0:  # what came before the first that we hear of is not ours to count
            self._window.accept(low_bits)
            self._highest = low_bits
            return low_bits
        number = self.full_number(low_bits)
        overtaken = number < self._highest
        if not self._window.accept(number):
            return None
        if overtaken:
            self._ledger.lost = max(0, self._ledger.lost - 1)  # it was late, not lost
            if latest:
                self._ledger.stale += 1
                return None
        else:
            self._ledger.lost += number - self._highest - 1
            self._highest = number
        return number


class ReliableInbox:
    """Messages to be delivered once and in order; later ones wait for the earlier.

    As many may wait as a sender may have outstanding, and of all topics no more than the budget; a
    message beyond that is dropped. next_number: where a former life of ours has left off.
    """

    def __init__(self, budget: Budget, next_number: int | None = None) -> None:
        self._budget = budget
        self._next = next_number
        self._waiting: dict[int, Arrived] = {}

    def arrived(self, message: Arrived, back: int) -> tuple[list[Arrived], list[int]]:
        """What can be delivered now, in order, and the numbers that will not come any more.

        back: how many numbers before this one the oldest is that may still come.
        """
        number = self._expand(message.number)
        never = self._begin(number - back)
        assert self._next is not None, "waiting has begun"
        in_window = self._next <= number < self._next + 2 * MAX_OUTSTANDING
        has_room = number == self._next or self._budget.has_room(len(message.payload))
        if in_window and has_room and number not in self._waiting:
            self._waiting[number] = message
            self._budget.held_bytes += len(message.payload)
        ready, missed = self._advance(number - back)
        return ready, never + missed

    def skip(self, low_bits: int) -> tuple[list[Arrived], list[int]]:
        """Numbers before this one will not come; what can be delivered now, and those numbers."""
        number = self._expand(low_bits)
        never = self._begin(number)
        ready, missed = self._advance(number)
        return ready, never + missed

    def settled(self, low_bits: int) -> int | None:
        """The full number of a message that is not waited for any more; None for any other."""
        number = self._expand(low_bits)
        return number if self._next is not None and number < self._next else None

    def full_number(self, low_bits: int) -> int:
        """A message's number, of which the wire has the low bits."""
        return self._expand(low_bits)

    def _begin(self, number: int) -> list[int]:
        """Wait for this number if nothing has come before; the numbers that never will.

        A sender whose first messages all expired on the way waits to hear that they did not come. More
        than it may have outstanding were settled with a former life of ours.
        """
        if self._next is not None:
            return []
        self._next = number
        return list(range(number)) if number <= MAX_OUTSTANDING else []

    def _expand(self, low_bits: int) -> int:
        return low_bits if self._next is None else expand(low_bits, MESSAGE_NUMBER_BITS, self._next)

    def _advance(self, floor: int) -> tuple[list[Arrived], list[int]]:
        assert self._next is not None
        ready, missed = [], []
        floor = min(floor, self._next + 2 * MAX_OUTSTANDING)  # a sender of ours skips no more at a time
        while self._next < floor:
            message = self._waiting.pop(self._next, None)
            if message is not None:
                ready.append(message)
            else:
                missed.append(self._next & 0xFFFF)
            self._next += 1
        while (message := self._waiting.pop(self._next, None)) is not None:
            ready.append(message)
            self._next += 1
        self._budget.held_bytes -= sum(len(message.payload) for message in ready)
        return ready, missed


class StateInbox:
    """A state that both sides share: entries, each from the newest message that named it."""

    def __init__(self, budget: Budget) -> None:
        self._budget = budget
        self._highest = -1
        self._entries: dict[int, tuple[int, bytes | None]] = {}

    def arrived(self, message: Arrived) -> bytes | None:
        """The whole state if the message changes it, else None. Raises DecodeError."""
        changes, whole = decode_entries(message.payload)
        if whole:
            changes = {**dict.fromkeys(self._entries), **changes}
        near = message.number if self._highest < 0 else self._highest
        number = expand(message.number, MESSAGE_NUMBER_BITS, near)
        self._highest = max(self._highest, number)
        changed = False
        for name, raw in changes.items():
            known_number, known = self._entries.get(name, (-(1 << 62), None))
            if number > known_number:
                changed |= raw != known or name not in self._entries
                self._budget.held_bytes += _entry_bytes(raw)
                if name in self._entries:
                    self._budget.held_bytes -= _entry_bytes(known)
                self._entries[name] = number, raw
        self._shed()
        return b"".join(raw for _, raw in self._entries.values() if raw is not None) if changed else None

    def _shed(self) -> None:
        while self._entries and not self._budget.has_room(0):
            _, raw = self._entries.pop(next(iter(self._entries)))
            self._budget.held_bytes -= _entry_bytes(raw)


def _entry_bytes(raw: bytes | None) -> int:
    return 64 + len(raw or b"")


Inbox = PlainInbox | ReliableInbox | StateInbox


@dataclass(frozen=True, slots=True)
class InTopic:
    """One of the peer's topic ids: what it stands for, how it is read, and whether we take it."""

    name: TopicName
    reader: Reader
    trouble: TroubleTeller
    ledger: ReceivedLedger
    accepted: bool

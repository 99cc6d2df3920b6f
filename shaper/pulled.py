"""What became of an answer to a question: told to who gave it, as for reliable messages."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from shaper.events import Event, Receipt, ReceiptStage

_MAX_UNDER_WAY = 16  # answers whose fate is followed; an answer takes a round trip at most


@dataclass(slots=True)
class _Fate:
    tag: int
    sent_parts: int = 0
    arrived_parts: int = 0
    lost_parts: int = 0
    needed_parts: int | None = None  # known when the last part has left


@dataclass(frozen=True, slots=True)
class SentPart:
    """A part of an answer in a datagram."""

    fates: Fates
    number: int

    def on_arrived(self) -> None:
        self.fates.on_part(self.number, arrived=True)

    def on_lost(self) -> None:
        self.fates.on_part(self.number, arrived=False)


class Fates:
    """Of one topic: `sent` when the last byte has left, then `delivered` or `lost` as the peer reports."""

    def __init__(self, key: str, tell: Callable[[Event], None]) -> None:
        self._key = key
        self._tell = tell
        self._by_number: dict[int, _Fate] = {}

    def on_sent_part(self, number: int, tag: int) -> SentPart:
        """A part of answer `number` leaves."""
        fate = self._by_number.setdefault(number, _Fate(tag))
        fate.sent_parts += 1
        while len(self._by_number) > _MAX_UNDER_WAY:
            del self._by_number[next(iter(self._by_number))]
        return SentPart(self, number)

    def on_sent(self, number: int, shares_needed: int) -> None:
        """The last part has left; shares_needed: of an answer under parity, else 0."""
        fate = self._by_number.get(number)
        if fate is not None:
            fate.needed_parts = shares_needed or fate.sent_parts
            self.tell(fate.tag, ReceiptStage.SENT)
            self._settle(number, fate)

    def on_part(self, number: int, *, arrived: bool) -> None:
        """The peer has reported on a part."""
        fate = self._by_number.get(number)
        if fate is None:
            return
        if arrived:
            fate.arrived_parts += 1
        else:
            fate.lost_parts += 1
        self._settle(number, fate)

    def forget(self, number: int) -> None:
        """It is begun anew, or given up: what is reported of it no longer counts."""
        self._by_number.pop(number, None)

    def tell(self, tag: int, stage: ReceiptStage) -> None:
        """Say how far an answer has come."""
        self._tell(Receipt(self._key, tag, stage))

    def _settle(self, number: int, fate: _Fate) -> None:
        if fate.needed_parts is None:
            return
        if fate.arrived_parts >= fate.needed_parts:
            self.tell(fate.tag, ReceiptStage.DELIVERED)
        elif fate.sent_parts - fate.lost_parts < fate.needed_parts:
            self.tell(fate.tag, ReceiptStage.LOST)
        else:
            return
        del self._by_number[number]

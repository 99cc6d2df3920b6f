"""Says that payloads and their encoding do not agree: soon, but not for each of thousands of messages."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from shaper.events import EncodingTrouble

REPEAT_NS = 10_000_000_000

What = Literal["refused", "altered", "unreadable"]


@dataclass(slots=True)
class TroubleTeller:
    """Of one topic: the first trouble of a kind is told at once, later ones together."""

    key: str
    _untold: dict[What, int] = field(default_factory=dict)
    _quiet_until_ns: dict[What, int] = field(default_factory=dict)

    def note(self, what: What, reason: str, now_ns: int) -> EncodingTrouble | None:
        """It befell a message; what is to be told, if anything."""
        count = self._untold[what] = self._untold.get(what, 0) + 1
        quiet_until_ns = self._quiet_until_ns.get(what)
        if quiet_until_ns is not None and now_ns < quiet_until_ns:
            return None
        self._untold[what] = 0
        self._quiet_until_ns[what] = now_ns + REPEAT_NS
        return EncodingTrouble(self.key, what, reason, count)

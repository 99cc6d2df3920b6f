"""What a person should know of the link: a kind for programs, a sentence for people."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class NoticeKind(StrEnum):
    """What has happened. Those that are a fault are for somebody to act on."""

    SECURED = "secured"  # both sides have proved that they hold the key
    PEER_MOVED = "peer_moved"
    NO_ANSWER = "no_answer"
    UNKNOWN_KEY = "unknown_key"
    WRONG_KEY = "wrong_key"
    CLOCK_DIFFERS = "clock_differs"
    TABLE_AGREES = "table_agrees"
    TABLE_DIFFERS = "table_differs"
    PATH_MTU = "path_mtu"
    MESSAGES_LOST = "messages_lost"

    @property
    def is_fault(self) -> bool:
        return self not in _NEWS


_NEWS = frozenset({NoticeKind.SECURED, NoticeKind.PEER_MOVED, NoticeKind.TABLE_AGREES})


@dataclass(frozen=True, slots=True)
class Notice:
    """News of the link. text: a full sentence that says what to do where something can be done."""

    kind: NoticeKind
    text: str

"""What a side remembers of reliable messages when its process is killed, and how it is asked for it.

Of our own messages: what waits, what has begun to leave and under which number. Of the peer's: which
numbers of which topic have been settled, and how, or are just being handed to the local bus. A live
daemon keeps this in a file (`shaper.journal_file`); virtual time and tests in memory, which outlives
the endpoint like a file outlives a process. Each call is on record when it returns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

from shaper.frames import Outcome

REMEMBERED_OUTCOMES = 128  # of each topic: more than a sender has under way
MAX_TOPICS = 4096  # of peers, whose outcomes are remembered
MAX_MEMORIES = 4  # of former peers: a peer whose own journal is gone comes as another


@dataclass(frozen=True, slots=True)
class OwnMessage:
    """A message of ours without an outcome. number: under which it began to leave, or None."""

    serial: int
    key: str
    tag: int
    capture_ns: int
    encoding: str
    payload: bytes
    number: int | None = None


class Journal(Protocol):
    """memory: by which the peer knows this journal. peer_memory: of the peer that was met last."""

    memory: bytes
    peer_memory: bytes

    def begin_life(self) -> int:
        """An epoch (16 bits) that none of the last 65 535 processes with this journal had."""

    def own_messages(self) -> list[OwnMessage]:
        """Those without an outcome when the journal was opened, oldest first."""

    def next_numbers(self) -> dict[str, int]:
        """By key, the number after the last one that has begun to leave."""

    def accept(self, key: str, tag: int, capture_ns: int, encoding: str, payload: bytes) -> int | None:
        """A message of ours waits; its serial number, or None if the journal is full."""

    def depart(self, serial: int, key: str, number: int) -> None:
        """It begins to leave under this number."""

    def settle(self, serial: int) -> None:
        """It is known what became of it."""

    def outcomes(self, memory: bytes, key: str) -> dict[int, Outcome | None]:
        """The newest settled numbers of a peer's topic; None for one that was being handed over."""

    def record(self, memory: bytes, key: str, number: int, outcome: Outcome | None) -> None:
        """A number is settled, or (None) is about to be handed to the local bus."""

    def meet(self, memory: bytes) -> None:
        """A peer with this memory has been met."""


class MemoryJournal:
    """A journal that lives as long as its object: as much as a file's, for tests and virtual time."""

    def __init__(self, memory: bytes, max_messages: int = 4096, max_bytes: int = 16_000_000) -> None:
        self.memory = memory
        self.peer_memory = b""
        self.held_bytes = 0
        self._lives = int.from_bytes(memory[:2], "little")
        self._max_messages = max_messages
        self._max_bytes = max_bytes
        self._own: dict[int, OwnMessage] = {}
        self._serial = 0
        self._next: dict[str, int] = {}
        self._theirs: dict[bytes, dict[str, dict[int, Outcome | None]]] = {}

    def begin_life(self) -> int:
        self._lives = self._lives + 1 & 0xFFFF
        return self._lives

    def own_messages(self) -> list[OwnMessage]:
        return list(self._own.values())

    def next_numbers(self) -> dict[str, int]:
        return dict(self._next)

    def accept(self, key: str, tag: int, capture_ns: int, encoding: str, payload: bytes) -> int | None:
        if len(self._own) >= self._max_messages or self.held_bytes + len(payload) > self._max_bytes:
            return None
        self._serial += 1
        self.held_bytes += len(payload)
        self._own[self._serial] = OwnMessage(self._serial, key, tag, capture_ns, encoding, payload)
        return self._serial

    def depart(self, serial: int, key: str, number: int) -> None:
        self._own[serial] = replace(self._own[serial], number=number)
        self._next[key] = number + 1

    def settle(self, serial: int) -> None:
        message = self._own.pop(serial, None)
        if message is not None:
            self.held_bytes -= len(message.payload)

    def outcomes(self, memory: bytes, key: str) -> dict[int, Outcome | None]:
        return dict(self._theirs.get(memory, {}).get(key, {}))

    def record(self, memory: bytes, key: str, number: int, outcome: Outcome | None) -> None:
        if memory not in self._theirs and len(self._theirs) >= MAX_MEMORIES:
            del self._theirs[next(iter(self._theirs))]
        topics = self._theirs.setdefault(memory, {})
        if key not in topics and len(topics) >= MAX_TOPICS:
            del topics[next(iter(topics))]
        outcomes = topics.setdefault(key, {})
        outcomes[number] = outcome
        while len(outcomes) > REMEMBERED_OUTCOMES:
            del outcomes[min(outcomes)]

    def meet(self, memory: bytes) -> None:
        self.peer_memory = memory

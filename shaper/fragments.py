"""Putting the parts, or enough shares, of large messages together again, in bounded memory."""

from __future__ import annotations

from bisect import insort
from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

from shaper.errors import DecodeError
from shaper.parity import decode_shares

PART_OVERHEAD_BYTES = 128  # what holding one piece costs beside its data; a flood of tiny ones counts too
_REMEMBERED = 512  # messages known to be complete, so that what is late of them starts nothing anew

Key = tuple[int, int]


@dataclass(slots=True)
class _Partial:
    total_bytes: int
    shares_needed: int  # 0 where it comes in plain parts
    started_ns: int
    first_sent_us: int
    pieces: dict[int, bytes] = field(default_factory=dict)  # by offset, or by index of the share
    covered: list[tuple[int, int]] = field(default_factory=list)  # of plain parts: [start, end)
    held_bytes: int = 0


class Reassembled(NamedTuple):
    """A complete message. first_sent_us: send stamp of the earliest piece, as the caller gave it."""

    data: bytes
    first_sent_us: int


class Reassembler:
    """Collects pieces by (topic, message number); the oldest unfinished message gives way first.

    max_bytes: data and bookkeeping of all unfinished messages together.
    max_message_bytes: a message that declares more is refused.
    max_wait_ns: an unfinished message older than this is given up. max_messages: unfinished at a time, in
    parts or under parity.
    """

    def __init__(
        self, max_bytes: int, max_message_bytes: int, max_wait_ns: int, max_messages: int = 4096
    ) -> None:
        self.max_messages = max_messages
        self.max_bytes = max_bytes
        self.max_message_bytes = max_message_bytes
        self.max_wait_ns = max_wait_ns
        self.held_bytes = 0
        self.given_up = 0  # unfinished messages that were dropped
        self._partials: dict[Key, _Partial] = {}
        self._done: deque[Key] = deque(maxlen=_REMEMBERED)
        self._done_set: set[Key] = set()

    def __len__(self) -> int:
        return len(self._partials)

    def add(
        self, key: Key, offset: int, total_bytes: int, data: bytes, sent_us: int, now_ns: int
    ) -> Reassembled | None:
        """Take a part; the whole message when nothing is missing any more.

        Repeated parts may be cut elsewhere than the first time: what is held already is kept.
        """
        partial = self._open(key, total_bytes, 0, sent_us, now_ns)
        if partial is None:
            return None
        for start, end in _uncovered(partial.covered, offset, offset + len(data)):
            self._hold(partial, start, data[start - offset : end - offset])
            insort(partial.covered, (start, end))
        if sum(end - start for start, end in partial.covered) == total_bytes:
            pieces = sorted(partial.pieces.items())
            return self._finish(key, partial, b"".join(piece for _, piece in pieces))
        self._shed()
        return None

    def add_share(
        self, key: Key, index: int, needed: int, total_bytes: int, data: bytes, sent_us: int, now_ns: int
    ) -> Reassembled | None:
        """Take a share; the whole message when there are enough."""
        partial = self._open(key, total_bytes, needed, sent_us, now_ns)
        if partial is None:
            return None
        if index not in partial.pieces:
            self._hold(partial, index, data)
        if len(partial.pieces) >= needed:
            try:
                whole = decode_shares(partial.pieces, needed, total_bytes)
            except DecodeError:
                self._give_up(key)
                raise
            return self._finish(key, partial, whole)
        self._shed()
        return None

    def clear(self) -> None:
        """Forget everything: the sender has started anew."""
        self._partials.clear()
        self._done.clear()
        self._done_set.clear()
        self.held_bytes = 0

    def _open(self, key: Key, total_bytes: int, needed: int, sent_us: int, now_ns: int) -> _Partial | None:
        """The message that a piece belongs to; None if it is complete, too large or contradicts itself."""
        self._expire(now_ns)
        if key in self._done_set:
            return None
        if total_bytes > self.max_message_bytes:
            self.given_up += 1
            return None
        partial = self._partials.get(key)
        if partial is None:
            partial = self._partials[key] = _Partial(total_bytes, needed, now_ns, sent_us)
        elif (partial.total_bytes, partial.shares_needed) != (total_bytes, needed):
            self._give_up(key)
            return None
        partial.first_sent_us = min(partial.first_sent_us, sent_us)
        return partial

    def _hold(self, partial: _Partial, at: int, data: bytes) -> None:
        partial.pieces[at] = data
        partial.held_bytes += len(data) + PART_OVERHEAD_BYTES
        self.held_bytes += len(data) + PART_OVERHEAD_BYTES

    def _shed(self) -> None:
        while self.held_bytes > self.max_bytes or len(self._partials) > self.max_messages:
            self._give_up(next(iter(self._partials)))

    def _finish(self, key: Key, partial: _Partial, data: bytes) -> Reassembled:
        self._forget(key)
        if len(self._done) == _REMEMBERED:
            self._done_set.discard(self._done[0])
        self._done.append(key)
        self._done_set.add(key)
        return Reassembled(data, partial.first_sent_us)

    def _expire(self, now_ns: int) -> None:
        while self._partials:
            key, oldest = next(iter(self._partials.items()))
            if now_ns - oldest.started_ns <= self.max_wait_ns:
                return
            self._give_up(key)

    def _give_up(self, key: Key) -> None:
        self._forget(key)
        self.given_up += 1

    def _forget(self, key: Key) -> None:
        self.held_bytes -= self._partials.pop(key).held_bytes


def _uncovered(covered: list[tuple[int, int]], start: int, end: int) -> list[tuple[int, int]]:
    """The parts of [start, end) that no interval of the sorted, disjoint list covers."""
    gaps = []
    for low, high in covered:
        if high <= start:
            continue
        if low >= end:
            break
        if low > start:
            gaps.append((start, low))
        start = max(start, high)
    if start < end:
        gaps.append((start, end))
    return gaps

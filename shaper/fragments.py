"""Putting the parts of large messages together again, in bounded memory."""

from __future__ import annotations

from dataclasses import dataclass, field

PART_OVERHEAD_BYTES = 128  # what holding one part costs beside its data; a flood of tiny parts counts too


@dataclass(slots=True)
class _Partial:
    total_bytes: int
    started_ns: int
    first_sent_ns: int
    parts: dict[int, bytes] = field(default_factory=dict)
    held_bytes: int = 0
    data_bytes: int = 0


@dataclass(frozen=True, slots=True)
class Reassembled:
    """A complete message. first_sent_ns: send stamp of the earliest part, as the caller gave it."""

    data: bytes
    first_sent_ns: int


class Reassembler:
    """Collects parts by (topic, message number); the oldest unfinished message gives way first.

    max_bytes: data and bookkeeping of all unfinished messages together.
    max_message_bytes: a message that declares more is refused.
    max_wait_ns: an unfinished message older than this is given up.
    """

    def __init__(self, max_bytes: int, max_message_bytes: int, max_wait_ns: int) -> None:
        self.max_bytes = max_bytes
        self.max_message_bytes = max_message_bytes
        self.max_wait_ns = max_wait_ns
        self.held_bytes = 0
        self.given_up = 0  # unfinished messages that were dropped
        self._partials: dict[tuple[int, int], _Partial] = {}

    def __len__(self) -> int:
        return len(self._partials)

    def add(
        self, key: tuple[int, int], offset: int, total_bytes: int, data: bytes, sent_ns: int, now_ns: int
    ) -> Reassembled | None:
        """Take a part; the whole message when it was the last one missing.

        A part that contradicts what is held (another total, an overlap) drops the whole message.
        """
        self._expire(now_ns)
        if total_bytes > self.max_message_bytes:
            self.given_up += key not in self._partials
            return None
        partial = self._partials.get(key)
        if partial is None:
            partial = self._partials[key] = _Partial(total_bytes, now_ns, sent_ns)
        if partial.total_bytes != total_bytes:
            self._give_up(key)
            return None
        if offset in partial.parts:
            return None
        partial.parts[offset] = data
        partial.first_sent_ns = min(partial.first_sent_ns, sent_ns)
        partial.data_bytes += len(data)
        partial.held_bytes += len(data) + PART_OVERHEAD_BYTES
        self.held_bytes += len(data) + PART_OVERHEAD_BYTES
        if partial.data_bytes >= total_bytes:
            return self._complete(key, partial)
        while self.held_bytes > self.max_bytes:
            self._give_up(next(iter(self._partials)))
        return None

    def clear(self) -> None:
        """Forget everything: the sender has started anew."""
        self._partials.clear()
        self.held_bytes = 0

    def _complete(self, key: tuple[int, int], partial: _Partial) -> Reassembled | None:
        ordered = sorted(partial.parts.items())
        expected = 0
        for offset, data in ordered:
            if offset != expected:
                self._give_up(key)
                return None
            expected += len(data)
        if expected != partial.total_bytes:
            self._give_up(key)
            return None
        self._forget(key)
        return Reassembled(b"".join(data for _, data in ordered), partial.first_sent_ns)

    def _expire(self, now_ns: int) -> None:
        while self._partials:
            key, oldest = next(iter(self._partials.items()))
            if now_ns - oldest.started_ns <= self.max_wait_ns:
                return
            self._give_up(key)

    def _give_up(self, key: tuple[int, int]) -> None:
        self._forget(key)
        self.given_up += 1

    def _forget(self, key: tuple[int, int]) -> None:
        self.held_bytes -= self._partials.pop(key).held_bytes

"""What has become of the peer's reliable messages, remembered beyond the lives of both processes."""

from __future__ import annotations

from collections.abc import Iterator

from shaper.frames import Outcome
from shaper.journal import REMEMBERED_OUTCOMES, Journal

_MESSAGE_NUMBER_MASK = 0xFFFF


class SettledTopic:
    """The outcomes of one topic of one peer. next_number: the first that has none; None if none has.

    A message that was being handed to the bus when this process was killed may have arrived there or not;
    handing it over again might double it. So it is told for what it is: uncertain.
    """

    def __init__(self, journal: Journal, memory: bytes, key: str) -> None:
        self._journal = journal
        self._memory = memory
        self._key = key
        self._outcomes = journal.outcomes(memory, key)
        for number, outcome in list(self._outcomes.items()):
            if outcome is None:
                self.settle(number, Outcome.UNCERTAIN)

    @property
    def next_number(self) -> int | None:
        return max(self._outcomes, default=-1) + 1 or None

    def hand_over(self, number: int) -> None:
        """A message is about to go to the local bus."""
        self._set(number, None)

    def settle(self, number: int, outcome: Outcome) -> None:
        """It is known what became of a number."""
        self._set(number, outcome)

    def outcome(self, number: int) -> Outcome | None:
        """What became of a number, if that is known and not forgotten."""
        return self._outcomes.get(number)

    def known(self) -> Iterator[tuple[int, Outcome]]:
        """Low bits of the settled numbers, and what became of them."""
        for number, outcome in sorted(self._outcomes.items()):
            if outcome is not None:
                yield number & _MESSAGE_NUMBER_MASK, outcome

    def _set(self, number: int, outcome: Outcome | None) -> None:
        self._journal.record(self._memory, self._key, number, outcome)
        self._outcomes[number] = outcome
        while len(self._outcomes) > REMEMBERED_OUTCOMES:
            del self._outcomes[min(self._outcomes)]


class Settled:
    """All topics of the peer with one memory; what it forgot itself is not asked for again."""

    def __init__(self, journal: Journal, memory: bytes, max_topics: int) -> None:
        self.memory = memory
        self._journal = journal
        self._max_topics = max_topics
        self._topics: dict[str, SettledTopic] = {}

    def topic(self, key: str) -> SettledTopic:
        """The outcomes of a topic; the one asked for longest ago gives way, and is read anew if needed."""
        topic = self._topics.pop(key, None)
        if topic is None:
            topic = SettledTopic(self._journal, self.memory, key)
            if len(self._topics) >= self._max_topics:
                del self._topics[next(iter(self._topics))]
        self._topics[key] = topic
        return topic

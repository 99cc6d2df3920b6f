"""The sending half of a link without a way back: what is held goes round at a fixed rate, newest first.

Nobody tells what arrives, when the link is open, or what it carries; so nothing is estimated. What a window
may carry is held, and sent again and again: a new message before everything but one that is just leaving for
the first time; then whatever else is held, from the newest to the oldest, and that anew every `repeat_ns`. A
window at least so long brings all of it, whenever it opens; what was lost on the way comes with the next
round. docs/carousel.md has the figures. No I/O; time is an argument.
"""

from __future__ import annotations

from dataclasses import dataclass

from shaper.carousel_wire import (
    CHUNK_OVERHEAD_BYTES,
    CLEAR,
    MOST_CHUNKS,
    MOST_MESSAGES,
    CarouselMessage,
    Chunk,
    encode_chunk,
    encode_message,
)
from shaper.frames import IP_UDP_BYTES
from shaper.key_expression import matches
from shaper.ledger import SentLedger
from shaper.pacer import NS_PER_S, Pacer

_CREDIT_NS = 4_000_000  # what a late timer may catch up; the Finals' fast queue held 10 ms
_HELD_SHARE = 0.9  # of what is sent in `repeat_ns` may be held: the rest is for what is new meanwhile
_MOST_HELD = 4096  # messages; a receiver remembers more
_NEVER_NS = 1 << 62
_NS_PER_MS = 1_000_000


@dataclass(frozen=True, slots=True)
class CarouselTopic:
    """Which keys go round. latest: the newest of a key takes the place of the one before.

    ttl_ns: how long a message goes round at most; 0 for as long as there is room.
    min_period_ns: decimation, as in a TopicRule.
    """

    key_expression: str
    latest: bool = True
    ttl_ns: int = 60 * NS_PER_S
    min_period_ns: int = 0


@dataclass(frozen=True, slots=True)
class CarouselSettings:
    """rate_bps: on the wire, IP and UDP headers included. max_datagram_bytes: without those."""

    topics: tuple[CarouselTopic, ...]
    rate_bps: int
    repeat_ns: int = NS_PER_S // 2
    max_datagram_bytes: int = 1472

    @property
    def held_bytes(self) -> int:
        """How much can go round, on the wire."""
        return int(_HELD_SHARE * self.rate_bps * self.repeat_ns / (8 * NS_PER_S))


@dataclass(slots=True)
class CarouselCounters:
    """What went round. Of messages the ledgers tell."""

    carousel_rounds: int = 0
    carousel_datagrams: int = 0
    carousel_wire_bytes: int = 0


@dataclass(slots=True)
class _Held:
    """A message that goes round. left: whole, at least once."""

    key: str
    latest: bool
    blob: bytes
    wire_bytes: int
    until_ns: int
    ledger: SentLedger
    left: bool = False


@dataclass(slots=True)
class _Turn:
    """A message that is being sent, and how far."""

    message: int
    next_chunk: int = 0


class Carousel:
    """What goes round. life: random, new at each start. protection_bytes: what sealing adds."""

    def __init__(self, settings: CarouselSettings, life: int, now_ns: int, protection_bytes: int = 0) -> None:
        self.counters = CarouselCounters()
        self.ledgers: dict[str, SentLedger] = {}
        self._settings = settings
        self._life = life
        self._chunk_bytes = settings.max_datagram_bytes - CLEAR.size - protection_bytes - CHUNK_OVERHEAD_BYTES
        self._outer_bytes = settings.max_datagram_bytes - self._chunk_bytes + IP_UDP_BYTES
        credit_bytes = settings.rate_bps * _CREDIT_NS // (8 * NS_PER_S)
        self._pacer = Pacer(settings.rate_bps, credit_bytes, now_ns)
        self._held: dict[int, _Held] = {}  # oldest first
        self._held_bytes = 0
        self._newest: dict[str, int] = {}  # message of a key of which only the newest counts
        self._turns: list[_Turn] = []  # the last one is sent now
        self._waiting: _Held | None = None  # a newer sample of what is just leaving for the first time
        self._accepted_ns: dict[str, int] = {}  # for decimation
        self._next_message = 0
        self._round_at_ns = now_ns

    @property
    def held_bytes(self) -> int:
        """What goes round, on the wire."""
        return self._held_bytes

    @property
    def rate_bps(self) -> int:
        """On the wire."""
        return self._settings.rate_bps

    @property
    def topics(self) -> tuple[CarouselTopic, ...]:
        """What goes round."""
        return self._settings.topics

    def missed(self, key: str, count: int) -> None:
        """Count offers that newer ones replaced before they came to be made."""
        ledger = self.ledgers.setdefault(key, SentLedger())
        ledger.offered += count
        ledger.superseded += count

    def topic_of(self, key: str) -> CarouselTopic | None:
        """The topic that a key belongs to: the first that matches."""
        return next((t for t in self._settings.topics if matches(t.key_expression, key)), None)

    def offer(
        self, key: str, payload: bytes, encoding: str, capture_ns: int, unix_ns: int, now_ns: int
    ) -> bool:
        """A local publisher has a message; whether it goes round.

        capture_ns: when it was captured, by this host's monotonic clock; unix_ns: by its wall clock.
        """
        topic = self.topic_of(key)
        if topic is None:
            return False
        ledger = self.ledgers.setdefault(key, SentLedger())
        ledger.offered += 1
        if topic.min_period_ns and now_ns - self._accepted_ns.get(key, -_NEVER_NS) < topic.min_period_ns:
            ledger.decimated += 1
            return False
        ttl_ms = topic.ttl_ns // _NS_PER_MS
        message = CarouselMessage(
            key, encoding, payload, capture_ns // 1000, max(0, unix_ns), ttl_ms, topic.latest
        )
        blob = encode_message(message)
        chunks = -(-len(blob) // self._chunk_bytes)
        wire_bytes = len(blob) + chunks * self._outer_bytes
        if chunks > MOST_CHUNKS or wire_bytes > self._settings.held_bytes:
            ledger.refused += 1
            return False
        if topic.min_period_ns:
            self._accepted_ns[key] = now_ns
        until_ns = capture_ns + topic.ttl_ns if topic.ttl_ns else _NEVER_NS
        self._hold(_Held(key, topic.latest, blob, wire_bytes, until_ns, ledger))
        return True

    def next_datagram(self, now_ns: int) -> bytes | None:
        """The next part of a message that may leave now, to be sealed; None if there is none."""
        if not self._pacer.may_send(now_ns):
            return None
        while self._turns or self._begin_round(now_ns):
            turn = self._turns[-1]
            held = self._held.get(turn.message)
            if held is None or now_ns >= held.until_ns:
                self._turns.pop()
                if held is not None:
                    self._drop(turn.message)
                    held.ledger.expired += not held.left
                self._hold_what_waits()
                continue
            return self._chunk(turn, held, now_ns)
        return None

    def wakeup_at_ns(self, now_ns: int) -> int:
        """When something may leave, if nothing happens before."""
        if self._turns:
            return self._pacer.next_send_at_ns(now_ns)
        if not self._held:
            return _NEVER_NS
        return max(self._round_at_ns, self._pacer.next_send_at_ns(now_ns))

    def _hold(self, held: _Held) -> None:
        """Let a message go round.

        What is leaving for the first time leaves whole before, or with more offered than the link carries
        each message would be overtaken half way and none would ever arrive.
        """
        leaving = self._leaving()
        if held.latest and leaving is not None and self._newest.get(held.key) == leaving:
            held.ledger.superseded += self._waiting is not None
            self._waiting = held
            return
        message, self._next_message = self._next_message, self._next_message + 1
        assert message < MOST_MESSAGES, "a carousel has gone round with four thousand million messages"
        if held.latest:
            before = self._newest.get(held.key)
            if before is not None:
                held.ledger.superseded += not self._drop(before).left
            self._newest[held.key] = message
        while self._held and (
            self._held_bytes + held.wire_bytes > self._settings.held_bytes or len(self._held) >= _MOST_HELD
        ):
            others = (message for message in self._held if message != leaving)
            oldest = self._drop(next(others, next(iter(self._held))))
            oldest.ledger.overflow += not oldest.left
        self._held[message] = held
        self._held_bytes += held.wire_bytes
        self._turns.insert(len(self._turns) - (leaving in self._held), _Turn(message))
        if len(self._turns) > 2 * len(self._held) + 16:  # mostly of messages that are not held any more
            self._turns = [turn for turn in self._turns if turn.message in self._held]

    def _leaving(self) -> int | None:
        """The message that has begun to leave for the first time."""
        turn = self._turns[-1] if self._turns else None
        if turn is None or turn.next_chunk == 0:
            return None
        held = self._held.get(turn.message)
        return None if held is None or held.left else turn.message

    def _drop(self, message: int) -> _Held:
        held = self._held.pop(message)
        self._held_bytes -= held.wire_bytes
        if self._newest.get(held.key) == message:
            del self._newest[held.key]
        return held

    def _begin_round(self, now_ns: int) -> bool:
        """Whether there is a round to begin now."""
        if now_ns < self._round_at_ns or not self._held:
            return False
        self._round_at_ns = now_ns + self._settings.repeat_ns
        self._turns = [_Turn(message) for message in self._held]  # the newest is the last, and sent first
        self.counters.carousel_rounds += 1
        return True

    def _chunk(self, turn: _Turn, held: _Held, now_ns: int) -> bytes:
        count = -(-len(held.blob) // self._chunk_bytes)
        begin = turn.next_chunk * self._chunk_bytes
        data = held.blob[begin : begin + self._chunk_bytes]
        body = encode_chunk(Chunk(self._life, turn.message, turn.next_chunk, count, data))
        wire_bytes = len(data) + self._outer_bytes
        self._pacer.on_sent(wire_bytes, now_ns)
        self.counters.carousel_datagrams += 1
        self.counters.carousel_wire_bytes += wire_bytes
        turn.next_chunk += 1
        held.ledger.sent_bytes += 0 if held.left else len(data)
        held.ledger.repeated_bytes += len(data) if held.left else 0
        if turn.next_chunk == count:
            self._turns.pop()
            held.ledger.sent += not held.left
            held.left = True
            self._hold_what_waits()
        return body

    def _hold_what_waits(self) -> None:
        waiting, self._waiting = self._waiting, None
        if waiting is not None:
            self._hold(waiting)

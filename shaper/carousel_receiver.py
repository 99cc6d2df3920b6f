"""The receiving half of a link without a way back: parts come again and again; each message leaves once."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from shaper.carousel_wire import CarouselMessage, Chunk, decode_chunk, decode_message
from shaper.errors import DecodeError
from shaper.events import FOREVER_NS, Delivered
from shaper.incoming import Limits
from shaper.key_expression import is_key, matches
from shaper.ledger import ReceivedLedger

_REMEMBERED = 65_536  # messages behind the newest that are known to be done with, or too old
_FORMER_LIVES = 8
_CHUNK_COST_BYTES = 64  # of keeping a part, beside its bytes
_NS_PER_MS = 1_000_000

AgeOf = Callable[[int, int], int | None]
"""The age (ns) of what the peer stamped with the low 32 bits of its clock (us), now (ns); None if unknown."""


@dataclass(slots=True)
class ReceiverCounters:
    """What became of what came."""

    carousel_received_datagrams: int = 0
    carousel_malformed: int = 0
    carousel_repeated: int = 0  # parts that were here already: the price of having no way back
    carousel_refused: int = 0  # of keys that are not accepted
    carousel_given_up: int = 0  # unfinished ones that made room for newer ones


@dataclass(slots=True)
class _Unfinished:
    count: int
    chunks: dict[int, bytes] = field(default_factory=dict)
    cost_bytes: int = 0


class CarouselReceiver:
    """Puts messages together.

    accept: key expressions; limits: what a peer may make us hold; ledgers: of what is delivered, by key.
    """

    def __init__(
        self, limits: Limits, accept: tuple[str, ...], ledgers: dict[str, ReceivedLedger], age_of: AgeOf
    ) -> None:
        self.counters = ReceiverCounters()
        self._ledgers = ledgers
        self._limits = limits
        self._accept = accept
        self._age_of = age_of
        self._former: deque[int] = deque(maxlen=_FORMER_LIVES)
        self._begin(-1)

    @property
    def held_bytes(self) -> int:
        """Of unfinished messages."""
        return self._held_bytes

    def receive(self, body: bytes, now_ns: int) -> Delivered | None:
        """Take an opened datagram; the message that is whole with it. What is malformed is counted."""
        self.counters.carousel_received_datagrams += 1
        try:
            chunk = decode_chunk(body)
            blob = self._add(chunk)
            return None if blob is None else self._deliver(decode_message(blob), chunk.message, now_ns)
        except DecodeError:
            self.counters.carousel_malformed += 1
            return None

    def _begin(self, life: int) -> None:
        """Another life of the sender: it counts its messages from the start."""
        self._life = life
        self._unfinished: dict[int, _Unfinished] = {}
        self._held_bytes = 0
        self._done: set[int] = set()
        self._floor = 0  # messages below it are done with, or too old to be told from those that are
        self._newest: dict[str, int] = {}

    def _add(self, chunk: Chunk) -> bytes | None:
        """A message that this part makes whole."""
        if chunk.life != self._life:
            if chunk.life in self._former:
                self.counters.carousel_repeated += 1
                return None
            self._former.append(self._life)
            self._begin(chunk.life)
        number = chunk.message
        if number < self._floor or number in self._done:
            self.counters.carousel_repeated += 1
            return None
        unfinished = self._unfinished.get(number)
        if unfinished is None:
            unfinished = self._unfinished[number] = _Unfinished(chunk.count)
        if chunk.count != unfinished.count:
            raise DecodeError(f"message {number} has {unfinished.count} chunks, not {chunk.count}")
        if chunk.index in unfinished.chunks:
            self.counters.carousel_repeated += 1
            return None
        unfinished.chunks[chunk.index] = chunk.data
        cost_bytes = len(chunk.data) + _CHUNK_COST_BYTES
        unfinished.cost_bytes += cost_bytes
        self._held_bytes += cost_bytes
        if len(unfinished.chunks) == unfinished.count:
            self._forget(number)
            self._finish(number)
            return b"".join(unfinished.chunks[index] for index in range(unfinished.count))
        self._keep_within_limits(number, unfinished)
        return None

    def _keep_within_limits(self, number: int, growing: _Unfinished) -> None:
        limits = self._limits
        if growing.cost_bytes > limits.max_message_bytes + growing.count * _CHUNK_COST_BYTES:
            self._forget(number)
            self._finish(number)
            raise DecodeError(f"a message is larger than {limits.max_message_bytes} bytes")
        while (
            self._held_bytes > limits.max_reassembly_bytes
            or len(self._unfinished) > limits.max_unfinished_messages
        ):
            self._forget(min(self._unfinished))  # the oldest: newest first
            self.counters.carousel_given_up += 1

    def _forget(self, number: int) -> None:
        self._held_bytes -= self._unfinished.pop(number).cost_bytes

    def _finish(self, number: int) -> None:
        self._done.add(number)
        if len(self._done) > _REMEMBERED:
            self._floor = sorted(self._done)[_REMEMBERED // 2]
            self._done = {done for done in self._done if done >= self._floor}
            for old in [old for old in self._unfinished if old < self._floor]:
                self._forget(old)

    def _deliver(self, message: CarouselMessage, number: int, now_ns: int) -> Delivered | None:
        key = message.key
        if not is_key(key) or not any(matches(expression, key) for expression in self._accept):
            self.counters.carousel_refused += 1
            return None
        ledger = self._ledgers.get(key, ReceivedLedger())
        if len(self._ledgers) < self._limits.max_topics:
            self._ledgers[key] = ledger
        age_ns, ttl_ns = self._age_of(message.capture_us, now_ns), message.ttl_ms * _NS_PER_MS
        if ttl_ns and age_ns is not None and age_ns > ttl_ns:
            ledger.expired += 1
            return None
        if message.latest:
            if number < self._newest.get(key, -1):
                ledger.stale += 1
                return None
            if key in self._newest or len(self._newest) < self._limits.max_topics:
                self._newest[key] = number
        ledger.on_delivered(len(message.payload), age_ns)
        left_ns = ttl_ns - (age_ns or 0) if ttl_ns else FOREVER_NS
        return Delivered(
            key, message.payload, message.encoding, number, message.capture_unix_ns, None, age_ns, left_ns
        )

"""The sending half: queues, names and the filling of datagrams."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Mapping
from functools import partial
from typing import NamedTuple

from messages.payload import StreamEncoding
from shaper.datagram import SHARE_OVERHEAD_BYTES, append_message, append_skip, message_overhead_bytes
from shaper.demand import Demand, PullQueue
from shaper.events import Event, Receipt, ReceiptStage
from shaper.frames import HEADER_BYTES, MAX_SHARES, MessageFrame, Outcome, SkipFrame, TopicName
from shaper.journal import Journal, OwnMessage
from shaper.journaled_queue import JournaledQueue
from shaper.key_expression import is_key
from shaper.ledger import SentLedger
from shaper.parity import protect
from shaper.path import Content
from shaper.queues import Departure, Payload, Piece, TopicQueue
from shaper.reliable import ReliableQueue, SentSkip
from shaper.scheduler import Scheduler
from shaper.shared_state import ChangesQueue
from shaper.stream_queue import StreamQueue
from shaper.traffic_class import Keep, TopicRule, first_match
from shaper.wire_type import WIRE_TYPE_BYTES

MAX_NAME_BYTES = 160  # key and encoding of a topic: they must fit the smallest datagram beside a part
_MIN_PART_BYTES = 48  # a smaller part of a message costs more in headers than it fills of a datagram
_SKIP_BYTES = 8
_NS_PER_MS = 1_000_000
_NS_PER_S = 1_000_000_000


class Opportunity(NamedTuple):
    """A datagram that may leave now.

    limit_bytes: what it should hold at the link's rate; max_bytes: what it may hold at all. timed: it leaves
    in a train, so that shares that were cut for a faster link wait for the next one.
    """

    limit_bytes: int
    max_bytes: int
    rate_bps: int
    loss_ratio: float
    now_ns: int
    only_always_send: bool = False
    only_emergency: bool = False
    timed: bool = False


class Outgoing:
    """Everything that waits to cross, and the names under which the peer knows it."""

    def __init__(
        self,
        rules: tuple[TopicRule, ...],
        max_topics: int,
        max_message_bytes: int,
        guaranteed: Mapping[int, float] | None = None,
        journal: Journal | None = None,
    ) -> None:
        self._journal = journal
        self._refused_there: frozenset[str] = frozenset()
        self.scheduler = Scheduler(guaranteed)
        self.demand = Demand()
        self.events: deque[Event] = deque()
        self.wanted: deque[PullQueue] = deque()  # topics whose newest item is to be asked for
        self.unmatched = 0  # messages that no rule sends
        self.refused = 0  # messages beyond max_topics or max_message_bytes
        self._rules = rules
        self._max_topics = max_topics
        self._max_message_bytes = max_message_bytes
        self._queues: dict[str, TopicQueue | None] = {}
        self._identified: dict[tuple[TopicQueue, str], tuple[int, TopicName]] = {}
        self._queue_of_id: list[TopicQueue] = []
        self._confirmed: set[int] = set()
        self._awaiting: dict[TopicQueue, None] = {}  # that may await an outcome; looked at when asked
        self._has_pull_topics = any(rule.pull for rule in rules)
        for rule in rules:
            if rule.pull:
                self._open(rule.key_expression)

    def offer(
        self, key: str, payload: Payload, encoding: str, capture_ns: int, now_ns: int, tag: int = 0
    ) -> bool:
        """Queue a message, or drop it and say so in the ledger; whether one more waits than before."""
        try:
            queue = self._queues[key]
            self.unmatched += queue is None
        except KeyError:
            queue = self._open(key)
        if queue is None:
            return False
        if self._refused_there and queue.rule.key_expression in self._refused_there:
            self.refused += 1
            queue.ledger.offered += 1
            queue.ledger.refused += 1
            return False
        name_bytes = _name_bytes(key, encoding) + (WIRE_TYPE_BYTES if queue.rule.encoding else 0)
        if len(payload) > self._max_message_bytes or name_bytes > MAX_NAME_BYTES:
            self.refused += 1
            queue.ledger.offered += 1
            queue.ledger.overflow += 1
            return False
        if not queue.offer(payload, encoding, capture_ns, now_ns, tag):
            return False
        self.scheduler.activate(queue)
        return True

    def refuse(self, key_expressions: tuple[str, ...]) -> None:
        """The peer does not mean the topics of these rules as we do: what is offered of them is dropped."""
        self._refused_there = frozenset(key_expressions)

    def restore(self, now_ns: int) -> None:
        """Take up what the journal holds of a former process's messages."""
        if self._journal is None:
            return
        by_key: dict[str, list[OwnMessage]] = {key: [] for key in self._journal.next_numbers()}
        for message in self._journal.own_messages():
            by_key.setdefault(message.key, []).append(message)
        for key, messages in by_key.items():
            queue = self._open(key)
            if isinstance(queue, JournaledQueue):
                queue.restore(messages, self._journal.next_numbers().get(key, 0), now_ns)
                continue
            for message in messages:  # the rules are others now
                settle = partial(self._journal.settle, message.serial)
                self.events.append(Receipt(key, message.tag, ReceiptStage.LOST, settle))

    def missed(self, key: str, count: int) -> None:
        """Count messages of a topic that newer ones replaced on the way here."""
        queue = self._queues.get(key)
        if queue is not None:
            queue.ledger.offered += count
            queue.ledger.superseded += count

    def queues(self) -> Iterator[TopicQueue]:
        """The topics that this side sends, in the order in which they appeared."""
        # A copy, because metrics are scraped by another thread.
        return (queue for queue in list(self._queues.values()) if queue is not None)

    def ledgers(self) -> dict[str, SentLedger]:
        """Counters by key, in the order in which the topics appeared."""
        return {queue.key: queue.ledger for queue in self.queues()}

    def identified(self) -> Iterator[tuple[int, TopicQueue]]:
        """Topics that the peer can tell by a short number."""
        return ((topic_id, self._queue_of_id[topic_id]) for topic_id in sorted(self._confirmed))

    @property
    def awaits_outcomes(self) -> bool:
        """Whether anything has left of which the peer must still say what became of it."""
        while self._awaiting:
            queue = next(iter(self._awaiting))
            if isinstance(queue, ReliableQueue | ChangesQueue) and queue.awaits_outcome:
                return True
            del self._awaiting[queue]
        return False

    def wants_at_ns(self) -> int | None:
        """When the next item of a pull topic falls due."""
        if not self._has_pull_topics:
            return None
        due = [queue.next_ask_ns() for queue in self.queues() if isinstance(queue, PullQueue)]
        return min((at_ns for at_ns in due if at_ns is not None), default=None)

    def want_what_is_due(self, now_ns: int) -> None:
        """Put pull topics whose period has passed in line."""
        for queue in self.queues():
            if isinstance(queue, PullQueue) and queue.ask_if_due(now_ns):
                self.scheduler.activate(queue)

    # What the peer says.

    def on_peer_restarted(self, *, remembers: bool = False) -> None:
        """It knows no names any more, and has forgotten what it had received.

        remembers: not so what it had received of journaled topics.
        """
        self._confirmed.clear()
        for queue in self.queues():
            if remembers and isinstance(queue, JournaledQueue):
                queue.on_peer_resumed()
            else:
                queue.on_peer_restarted()

    def on_known(self, topic_ids: tuple[int, ...]) -> None:
        """The peer can tell these topics by their ids alone."""
        self._confirmed.update(i for i in topic_ids if i < len(self._queue_of_id))

    def on_outcome(self, topic_id: int, number_low_bits: int, outcome: Outcome) -> None:
        """The peer says what became of a message."""
        if topic_id < len(self._queue_of_id):
            queue = self._queue_of_id[topic_id]
            if isinstance(queue, ReliableQueue | ChangesQueue):
                queue.on_outcome(number_low_bits, outcome)

    def queue_of(self, topic_id: int) -> TopicQueue | None:
        """The topic that an id of ours stands for."""
        return self._queue_of_id[topic_id] if topic_id < len(self._queue_of_id) else None

    # Filling datagrams.

    def fill(self, out: bytearray, opportunity: Opportunity) -> tuple[bool, tuple[Content, ...]]:
        """Append messages while they fit; whether anything was, and what wants to know of its fate."""
        start = len(out)
        contents: list[Content] = []
        while True:
            queue = self.scheduler.next_queue(
                only_always_send=opportunity.only_always_send, only_emergency=opportunity.only_emergency
            )
            if queue is None:
                break
            if isinstance(queue, ReliableQueue) and queue.skip_due:
                if len(out) + _SKIP_BYTES + MAX_NAME_BYTES > opportunity.max_bytes:
                    break
                contents += self._append_skip(out, queue)
                continue
            if isinstance(queue, PullQueue) and queue.wanted:
                queue.ask(opportunity.now_ns)
                self.wanted.append(queue)
                continue
            piece = queue.next_piece(opportunity.now_ns)
            if piece is None:
                continue
            if not piece.again and self._too_late(queue, piece, opportunity):
                queue.too_late(piece)
                self.scheduler.message_done(queue)
                continue
            self._protect(queue, piece, opportunity)
            before = len(out)
            count = self._append_piece(out, queue, piece, opportunity, first=before == start)
            if count is None:
                break
            content = queue.sent(piece, count, opportunity.loss_ratio)
            if piece.departure.protected is not None:
                contents.append(piece.departure.protected)
            if content is not None:
                contents.append(content)
                self._awaiting[queue] = None
            frame_bytes = len(out) - before
            self.scheduler.on_sent(queue, frame_bytes)
            self.demand.on_sent(queue.rule.traffic_class.tier, frame_bytes, opportunity.now_ns)
            if not queue.message_under_way:
                self.scheduler.message_done(queue)
        return len(out) > start, tuple(contents)

    def _open(self, key: str) -> TopicQueue | None:
        rule = first_match(self._rules, key) if is_key(key) else None
        if rule is not None and len(self._queues) >= self._max_topics:
            self.refused += 1
            return None
        self.unmatched += rule is None
        queue = None if rule is None else self._make_queue(key, rule)
        if len(self._queues) < self._max_topics:
            self._queues[key] = queue
        return queue

    def _make_queue(self, key: str, rule: TopicRule) -> TopicQueue:
        wake, tell = self.scheduler.activate, self.events.append
        if rule.pull:
            return PullQueue(key, rule, wake, tell)
        if rule.traffic_class.keep is Keep.CHANGES:
            return ChangesQueue(key, rule, wake)
        if rule.traffic_class.reliable and self._journal is not None:
            return JournaledQueue(key, rule, wake, tell, self._journal)
        if rule.traffic_class.reliable:
            return ReliableQueue(key, rule, wake, tell)
        if isinstance(rule.encoding, StreamEncoding):
            return StreamQueue(key, rule, rule.encoding, wake, tell)
        return TopicQueue(key, rule, wake, tell)

    def _too_late(self, queue: TopicQueue, piece: Piece, opportunity: Opportunity) -> bool:
        """Whether the rest could not leave before the deadline even if it had the link for itself."""
        if queue.rule.traffic_class.keep is Keep.CHANGES:  # a state is true until it changes
            return False
        departure = piece.departure
        airtime_ns = departure.remaining_bytes * 8 * _NS_PER_S // opportunity.rate_bps
        return opportunity.now_ns + airtime_ns > departure.capture_ns + queue.rule.traffic_class.ttl_ns

    def _protect(self, queue: TopicQueue, piece: Piece, opportunity: Opportunity) -> None:
        """Put a message that will take several datagrams under parity, if the link loses packets."""
        departure, traffic_class = piece.departure, queue.rule.traffic_class
        if departure.begun or departure.protected is not None or not traffic_class.max_parity_ratio:
            return
        if not opportunity.loss_ratio or isinstance(queue, ReliableQueue | ChangesQueue):
            return
        # The age that is sent along grows while the message waits, and a share cannot be cut smaller.
        oldest_ns = departure.capture_ns + traffic_class.ttl_ns
        overhead = self._overhead_bytes(queue, departure, oldest_ns) + SHARE_OVERHEAD_BYTES
        needed = -(-len(departure.data) // (opportunity.limit_bytes - HEADER_BYTES - overhead))
        if not 2 <= needed < MAX_SHARES:
            return
        departure.protected = protect(
            departure.data,
            needed,
            opportunity.loss_ratio,
            traffic_class.target_ratio,
            traffic_class.max_parity_ratio,
        )

    def _append_piece(
        self, out: bytearray, queue: TopicQueue, piece: Piece, opportunity: Opportunity, *, first: bool
    ) -> int | None:
        """Append as much of a piece as fits; how much, or None if it had better wait for a datagram."""
        departure = piece.departure
        overhead = self._overhead_bytes(queue, departure, opportunity.now_ns)
        protected = departure.protected
        if protected is not None:
            share = protected.shares[protected.sent]
            # A share keeps its size when the link turns thin under it; then it leaves by itself.
            alone = first and not opportunity.timed
            limit = opportunity.max_bytes if alone else opportunity.limit_bytes
            if len(out) + overhead + SHARE_OVERHEAD_BYTES + len(share) > limit:
                return None
            self._append(out, queue, departure, protected.sent, share, opportunity.now_ns)
            return len(share)
        room = opportunity.limit_bytes - len(out) - overhead
        if first and room < _MIN_PART_BYTES:  # on the thinnest links a topic's name needs more than is meant
            room = min(_MIN_PART_BYTES, opportunity.max_bytes - len(out) - overhead)
        count = piece.length
        if count > room:
            # Splitting a message that would fit the next datagram whole only doubles its chance of loss.
            fits_next = not departure.begun and count + overhead + HEADER_BYTES <= opportunity.limit_bytes
            if room < _MIN_PART_BYTES or (fits_next and not first):
                return None
            count = room
        data = departure.data
        if count < len(data):
            data = data[piece.offset : piece.offset + count]
        self._append(out, queue, departure, piece.offset, data, opportunity.now_ns)
        return count

    def _append(
        self, out: bytearray, queue: TopicQueue, departure: Departure, offset: int, data: bytes, now_ns: int
    ) -> None:
        topic_id, name = self._identify(queue, departure.encoding)
        traffic_class = queue.rule.traffic_class
        changes = traffic_class.keep is Keep.CHANGES
        frame = MessageFrame(
            topic_id=topic_id,
            number=departure.number,
            age_us=_age_us(departure, now_ns),
            data=data,
            offset=offset,
            total_bytes=len(departure.data),
            name=name,
            latest=changes or traffic_class.keep is Keep.LATEST,
            compressed=departure.compressed,
            reliable=changes or traffic_class.reliable,
            back=departure.number - queue.first_outstanding() if isinstance(queue, ReliableQueue) else 0,
            shares_needed=departure.shares_needed,
        )
        append_message(out, frame)

    def _append_skip(self, out: bytearray, queue: ReliableQueue) -> list[Content]:
        topic_id, name = self._identify(queue, queue.encoding)
        append_skip(out, SkipFrame(topic_id, queue.take_skip(), name))
        return [SentSkip(queue)]

    def _overhead_bytes(self, queue: TopicQueue, departure: Departure, now_ns: int) -> int:
        topic_id, name = self._identify(queue, departure.encoding)
        age_us = _age_us(departure, now_ns)
        return message_overhead_bytes(topic_id, age_us, name, departure.offset, len(departure.data))

    def _identify(self, queue: TopicQueue, encoding: str) -> tuple[int, TopicName | None]:
        """The short number of a topic, and its name while the peer has not confirmed the number."""
        found = self._identified.get((queue, encoding))
        if found is None:
            found = self._identified[queue, encoding] = self._name(queue, encoding)
        topic_id, name = found
        return topic_id, None if topic_id in self._confirmed else name

    def _name(self, queue: TopicQueue, encoding: str) -> tuple[int, TopicName]:
        ttl_ns = queue.rule.traffic_class.ttl_ns
        ttl_ms = 0 if queue.rule.traffic_class.keep is Keep.CHANGES else -(-ttl_ns // _NS_PER_MS)
        self._queue_of_id.append(queue)
        return len(self._queue_of_id) - 1, TopicName(queue.key, encoding, ttl_ms)


def _age_us(departure: Departure, now_ns: int) -> int:
    return max(0, now_ns - departure.capture_ns) // 1000


def _name_bytes(key: str, encoding: str) -> int:
    return len(key.encode()) + len(encoding.encode())

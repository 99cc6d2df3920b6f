"""The sending half: queues, names and the filling of datagrams."""

from __future__ import annotations

from shaper.compression import pack
from shaper.datagram import HEADER_BYTES, MessageFrame, TopicName, append_message, message_overhead_bytes
from shaper.key_expression import is_key
from shaper.ledger import SentLedger
from shaper.queues import Departure, Payload, TopicQueue
from shaper.scheduler import Scheduler
from shaper.traffic_class import Keep, TopicRule, first_match

MAX_NAME_BYTES = 160  # key and encoding of a topic: they must fit the smallest datagram beside a part
_MIN_PART_BYTES = 48  # a smaller part of a message costs more in headers than it fills of a datagram
_NS_PER_S = 1_000_000_000


class Outgoing:
    """Everything that waits to cross, and the names under which the peer knows it."""

    def __init__(self, rules: tuple[TopicRule, ...], max_topics: int, max_message_bytes: int) -> None:
        self.scheduler = Scheduler()
        self.unmatched = 0  # messages that no rule sends
        self.refused = 0  # messages beyond max_topics or max_message_bytes
        self._rules = rules
        self._max_topics = max_topics
        self._max_message_bytes = max_message_bytes
        self._queues: dict[str, TopicQueue | None] = {}
        self._ids: dict[TopicName, int] = {}
        self._confirmed: set[int] = set()

    def offer(self, key: str, payload: Payload, encoding: str, capture_ns: int, now_ns: int) -> bool:
        """Queue a message, or drop it and say so in the ledger; whether one more waits than before."""
        try:
            queue = self._queues[key]
            self.unmatched += queue is None
        except KeyError:
            queue = self._open(key)
        if queue is None:
            return False
        if len(payload) > self._max_message_bytes or _name_bytes(key, encoding) > MAX_NAME_BYTES:
            self.refused += 1
            queue.ledger.offered += 1
            queue.ledger.overflow += 1
            return False
        if not queue.offer(payload, encoding, capture_ns, now_ns):
            return False
        self.scheduler.activate(queue)
        return True

    def ledgers(self) -> dict[str, SentLedger]:
        """Counters by key, in the order in which the topics appeared."""
        return {key: queue.ledger for key, queue in self._queues.items() if queue is not None}

    def forget_confirmations(self) -> None:
        """The peer has restarted: it knows no names any more."""
        self._confirmed.clear()

    def on_known(self, topic_ids: tuple[int, ...]) -> None:
        """The peer can tell these topics by their ids alone."""
        self._confirmed.update(i for i in topic_ids if i < len(self._ids))

    def fill(
        self,
        out: bytearray,
        limit_bytes: int,
        rate_bps: int,
        now_ns: int,
        *,
        only_always_send: bool,
        only_emergency: bool,
    ) -> bool:
        """Append messages to a datagram while they fit; whether anything was appended."""
        start = len(out)
        while True:
            queue = self.scheduler.next_queue(
                only_always_send=only_always_send, only_emergency=only_emergency
            )
            if queue is None:
                break
            departure = queue.departing or self._depart(queue, now_ns)
            if departure is None:
                continue
            if self._too_late(queue, departure, rate_bps, now_ns):
                queue.expire_departing()
                self.scheduler.message_done(queue)
                continue
            first = len(out) == start
            if not self._append_part(out, limit_bytes, queue, departure, now_ns, first=first):
                break
            if queue.departing is None:
                self.scheduler.message_done(queue)
        return len(out) > start

    def _open(self, key: str) -> TopicQueue | None:
        rule = first_match(self._rules, key) if is_key(key) else None
        if rule is not None and len(self._queues) >= self._max_topics:
            self.refused += 1
            return None
        self.unmatched += rule is None
        queue = None if rule is None else TopicQueue(key, rule)
        if len(self._queues) < self._max_topics:
            self._queues[key] = queue
        return queue

    def _depart(self, queue: TopicQueue, now_ns: int) -> Departure | None:
        message = queue.take(now_ns)
        if message is None:
            return None
        data, compressed = pack(bytes(message.payload), queue.rule.compression)
        queue.departing = Departure(data, message.encoding, message.capture_ns, queue.next_number, compressed)
        return queue.departing

    def _too_late(self, queue: TopicQueue, departure: Departure, rate_bps: int, now_ns: int) -> bool:
        """Whether the rest could not leave before the deadline even if it had the link for itself."""
        ttl_ns = queue.rule.traffic_class.ttl_ns
        airtime_ns = departure.remaining_bytes * 8 * _NS_PER_S // rate_bps
        return now_ns + airtime_ns > departure.capture_ns + ttl_ns

    def _append_part(
        self,
        out: bytearray,
        limit_bytes: int,
        queue: TopicQueue,
        departure: Departure,
        now_ns: int,
        *,
        first: bool,
    ) -> bool:
        """Append the message, or as much of it as fits; False if it had better wait for a datagram."""
        age_us = max(0, now_ns - departure.capture_ns) // 1000
        topic_id, name = self._identify(TopicName(queue.key, departure.encoding))
        offset, total = departure.offset, len(departure.data)
        overhead = message_overhead_bytes(topic_id, age_us, name, offset, total)
        room = limit_bytes - len(out) - overhead
        count = departure.remaining_bytes
        if count > room:
            # Splitting a message that would fit the next datagram whole only doubles its chance of loss.
            fits_next = offset == 0 and count + overhead + HEADER_BYTES <= limit_bytes
            if room < _MIN_PART_BYTES or (fits_next and not first):
                return False
            count = room
        data = departure.data if count == total else departure.data[offset : offset + count]
        latest = queue.rule.traffic_class.keep is Keep.LATEST
        append_message(
            out,
            MessageFrame(
                topic_id, departure.number, age_us, data, offset, total, name, latest, departure.compressed
            ),
        )
        self._advance(queue, departure, count)
        return True

    def _advance(self, queue: TopicQueue, departure: Departure, count: int) -> None:
        if departure.offset == 0:
            queue.next_number += 1
        departure.offset += count
        queue.ledger.sent_bytes += count
        if departure.remaining_bytes == 0:
            queue.ledger.sent += 1
            queue.departing = None

    def _identify(self, name: TopicName) -> tuple[int, TopicName | None]:
        """The short number of a topic, and its name while the peer has not confirmed the number."""
        topic_id = self._ids.setdefault(name, len(self._ids))
        return topic_id, None if topic_id in self._confirmed else name


def _name_bytes(key: str, encoding: str) -> int:
    return len(key.encode()) + len(encoding.encode())

"""The receiving half: from the peer's datagrams to messages, and what must be told back."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

from messages.payload import PayloadError
from shaper.compression import unpack
from shaper.errors import DecodeError
from shaper.events import FOREVER_NS, Delivered, Event
from shaper.fragments import Reassembled, Reassembler
from shaper.frames import (
    ARRIVED_BITS,
    NUMBER_BITS,
    Header,
    HelloFrame,
    KnownFrame,
    MessageFrame,
    Outcome,
    ReceiptFrame,
    ReportFrame,
    SkipFrame,
    TopicName,
)
from shaper.inbox import Arrived, Budget, Inbox, InTopic, PlainInbox, ReliableInbox, StateInbox
from shaper.key_expression import is_key, matches
from shaper.ledger import ReceivedLedger
from shaper.path import Content, PeerClock
from shaper.promise import PROMISES_NS
from shaper.reader import Streams, reader_of
from shaper.serial_number import ReceivedWindow, expand
from shaper.settled import Settled, SettledTopic
from shaper.trouble import TroubleTeller
from shaper.wire_type import Encodings

_MAX_EARLIER = 40  # arrivals named in one report beside the newest
_STREAM_NS = 110_000_000  # a sooner promise is of a backlog, a later one of regular messages (shaper.timers)
_SILENCE_NS = 300_000_000  # without a datagram for so long, the next one is reported on at once
_NS_PER_MS = 1_000_000
_LATEST_UNIX_NS = 1 << 62  # the year 2116; leaves room to add ages without leaving 64 bits
_OLD_IN_A_ROW = 3  # so many packets too old to tell and none else: the newest number was a forged one

AnyInbox = TypeVar("AnyInbox", PlainInbox, ReliableInbox, StateInbox)


@dataclass(frozen=True, slots=True)
class Limits:
    """What a peer may make us hold."""

    max_topics: int = 4096
    max_message_bytes: int = 4_000_000
    max_reassembly_bytes: int = 16_000_000
    max_reassembly_wait_ns: int = 60_000_000_000
    max_unfinished_messages: int = 4096
    max_receipts: int = 4096
    max_journal_messages: int = 4096
    max_journal_bytes: int = 16_000_000


@dataclass(frozen=True, slots=True)
class _SentReceipts:
    """Receipts on their way to the sender of the messages."""

    incoming: Incoming
    receipts: tuple[tuple[int, int, Outcome], ...]

    def on_arrived(self) -> None:
        """The sender knows."""

    def on_lost(self) -> None:
        self.incoming.repeat_receipts(self.receipts)


class Incoming:
    """One life of the peer: everything here is forgotten when its epoch changes.

    settled: what has become of its reliable messages, which is not.
    """

    def __init__(
        self,
        epoch: int,
        limits: Limits,
        accept: tuple[str, ...],
        ledgers: dict[str, ReceivedLedger],
        encodings: Encodings,
        tell: Callable[[Event], None],
        settled: Settled | None = None,
    ) -> None:
        self._settled = settled
        self.epoch = epoch
        self.clock = PeerClock()
        self.received = 0
        self.unreported_since_ns: int | None = None
        self.after_silence = False  # the peer may be waiting to hear that the link is back
        self.streams_until_ns = -(1 << 62)  # until then at least one more that wants a report is to come
        self._heard_ns = -(1 << 62)
        self.refused = 0
        self.unknown_topics = 0
        self._limits = limits
        self._accept = accept
        self._refused: tuple[str, ...] = ()
        self._ledgers = ledgers
        self._encodings = encodings
        self._streams: Streams = {}
        self._tell = tell
        self._window = ReceivedWindow()
        self._old_in_a_row = 0
        self._topics: dict[int, InTopic] = {}
        self._inboxes: dict[tuple[str, type[Inbox]], Inbox] = {}
        self._waiting_budget = Budget(limits.max_reassembly_bytes)
        self._states_budget = Budget(limits.max_reassembly_bytes)
        self._receipts: deque[tuple[int, int, Outcome]] = deque(maxlen=limits.max_receipts)
        self._to_confirm: dict[int, None] = {}
        self._arrivals: deque[tuple[int, int]] = deque(maxlen=_MAX_EARLIER + 1)
        self._largest_arrival = (-1, 0)
        self._unix_minus_stamp_ns: int | None = None
        self._reassembler = Reassembler(
            limits.max_reassembly_bytes,
            limits.max_message_bytes,
            limits.max_reassembly_wait_ns,
            limits.max_unfinished_messages,
        )

    def refuse(self, key_expressions: tuple[str, ...]) -> None:
        """Take nothing more of these, and of what was refused before whatever is not among them."""
        self._refused = key_expressions
        for topic_id, topic in self._topics.items():
            self._topics[topic_id] = replace(topic, accepted=self._accepts(topic.name.key))

    def _accepts(self, key: str) -> bool:
        refused = any(matches(expression, key) for expression in self._refused)
        return is_key(key) and not refused and any(matches(e, key) for e in self._accept)

    @property
    def given_up(self) -> int:
        """Fragmented messages that never became whole."""
        return self._reassembler.given_up

    @property
    def held_bytes(self) -> int:
        """Of unfinished messages, of those that wait for earlier ones, and of shared states."""
        return self._reassembler.held_bytes + self._waiting_budget.held_bytes + self._states_budget.held_bytes

    def accept_packet(self, header: Header, now_ns: int) -> int | None:
        """The full send stamp of a datagram not seen before (microseconds); None for a duplicate."""
        highest = self._window.highest
        number = expand(header.number, NUMBER_BITS, highest) if highest >= 0 else header.number
        if highest >= 0 and number <= highest - self._window.span:
            self._old_in_a_row += 1
            if self._old_in_a_row < _OLD_IN_A_ROW:
                return None
            self._window, self._largest_arrival = ReceivedWindow(), (-1, 0)
            number = header.number
        if not self._window.accept(number):
            return None
        self._old_in_a_row = 0
        self.received += 1
        self._arrivals.append((number, now_ns))
        if number > self._largest_arrival[0]:
            self._largest_arrival = (number, now_ns)
        if header.elicits_report:
            promise_ns = PROMISES_NS[header.promise]
            self.streams_until_ns = now_ns + promise_ns if promise_ns < _STREAM_NS else -(1 << 62)
        if header.elicits_report and self.unreported_since_ns is None:
            self.unreported_since_ns = now_ns
            self.after_silence = now_ns - self._heard_ns > _SILENCE_NS
        self._heard_ns = now_ns
        return self.clock.expand_stamp(header.stamp_us, now_ns)

    def on_hello(self, frame: HelloFrame, sent_us: int) -> None:
        """Learn the peer's wall clock."""
        if not 0 <= frame.unix_ns <= _LATEST_UNIX_NS:
            raise DecodeError(f"a wall clock of {frame.unix_ns} ns is outside 0..{_LATEST_UNIX_NS}")
        self._unix_minus_stamp_ns = frame.unix_ns - sent_us * 1000

    def on_message(self, frame: MessageFrame, sent_us: int, now_ns: int) -> list[Delivered]:
        """Take a message, a part or a share; the messages that can be delivered now."""
        topic = self._topic_of(frame)
        if topic is None:
            return []
        data, first_sent_us = frame.data, sent_us
        if not frame.is_whole:
            whole = self._reassemble(frame, sent_us, now_ns)
            if whole is None:
                return []
            data, first_sent_us = whole.data, whole.first_sent_us
        payload = unpack(data, self._limits.max_message_bytes) if frame.compressed else data
        message = Arrived(
            frame.topic_id, frame.number, payload, len(data), sent_us - frame.age_us, first_sent_us
        )
        if frame.reliable and frame.latest:
            return self._on_state(topic, message, now_ns)
        if frame.reliable:
            waiting = self._inbox(topic, ReliableInbox)
            if self._settled is not None and self._answer_again(self._settled, waiting, topic, frame):
                return []
            ready, missed = waiting.arrived(message, frame.back)
            return self._deliver_reliable(frame.topic_id, waiting, ready, missed, now_ns)
        inbox = self._inbox(topic, PlainInbox)
        if topic.reader.stream is not None:  # also of what is too old to be delivered: others refer to it
            message = self._read_in_stream(topic, message, inbox.full_number(frame.number))
        number = inbox.arrived(frame.number, frame.latest)
        if number is None:
            return []
        return _only_delivered(self._deliver(message, number, now_ns))

    def on_skip(self, frame: SkipFrame, now_ns: int) -> list[Delivered]:
        """Reliable messages will not come; those that waited for them can be delivered."""
        topic = self._topic_of(frame)
        if topic is None:
            return []
        inbox = self._inbox(topic, ReliableInbox)
        ready, missed = inbox.skip(frame.number)
        delivered = self._deliver_reliable(frame.topic_id, inbox, ready, missed, now_ns)
        if self._settled is not None:  # our receipts may have died with one of the two processes
            known = self._settled.topic(topic.name.key).known()
            self._receipts.extend((frame.topic_id, number, outcome) for number, outcome in known)
        return delivered

    def _reassemble(self, frame: MessageFrame, sent_us: int, now_ns: int) -> Reassembled | None:
        key, size = (frame.topic_id, frame.number), frame.total_bytes
        if frame.shares_needed:
            return self._reassembler.add_share(
                key, frame.offset, frame.shares_needed, size, frame.data, sent_us, now_ns
            )
        return self._reassembler.add(key, frame.offset, size, frame.data, sent_us, now_ns)

    def _on_state(self, topic: InTopic, message: Arrived, now_ns: int) -> list[Delivered]:
        state = self._inbox(topic, StateInbox).arrived(message)
        self._receipts.append((message.topic_id, message.number, Outcome.DELIVERED))
        if state is None:
            return []
        return _only_delivered(self._deliver(message._replace(payload=state), message.number, now_ns))

    def _deliver_reliable(
        self, topic_id: int, inbox: ReliableInbox, messages: list[Arrived], missed: list[int], now_ns: int
    ) -> list[Delivered]:
        if self._settled is not None:
            settled = self._settled.topic(self._topics[topic_id].name.key)
            return self._deliver_on_record(settled, topic_id, inbox, messages, missed, now_ns)
        delivered = []
        self._receipts.extend((topic_id, number, Outcome.EXPIRED) for number in missed)
        for message in messages:
            each = self._deliver(message, message.number, now_ns)
            outcome = Outcome.DELIVERED if isinstance(each, Delivered) else each
            self._receipts.append((message.topic_id, message.number, outcome))
            delivered += _only_delivered(each)
        return delivered

    def _deliver_on_record(
        self,
        settled: SettledTopic,
        topic_id: int,
        inbox: ReliableInbox,
        messages: list[Arrived],
        missed: list[int],
        now_ns: int,
    ) -> list[Delivered]:
        """As `_deliver_reliable`, in the order of the numbers, each on record before it goes to the bus."""
        due: dict[int, Arrived | None] = {inbox.full_number(number): None for number in missed}
        due |= {inbox.full_number(message.number): message for message in messages}
        delivered = []
        for number, message in sorted(due.items()):
            each = Outcome.EXPIRED if message is None else self._deliver(message, message.number, now_ns)
            if isinstance(each, Outcome):
                self._settle(settled, topic_id, number, each)
                continue
            settled.hand_over(number)
            done = partial(self._settle, settled, topic_id, number, Outcome.DELIVERED)
            delivered.append(replace(each, on_handed_over=done))
        return delivered

    def _settle(self, settled: SettledTopic, topic_id: int, number: int, outcome: Outcome) -> None:
        settled.settle(number, outcome)
        self._receipts.append((topic_id, number & 0xFFFF, outcome))

    def _answer_again(
        self, all_settled: Settled, inbox: ReliableInbox, topic: InTopic, frame: MessageFrame
    ) -> bool:
        """Whether a message was settled before: its sender has started anew, or missed our receipt."""
        number = inbox.settled(frame.number)
        if number is None:
            return False
        outcome = all_settled.topic(topic.name.key).outcome(number)
        if outcome is not None:
            self._receipts.append((frame.topic_id, frame.number, outcome))
        return True

    def _deliver(self, message: Arrived, number: int, now_ns: int) -> Delivered | Outcome:
        """The message for the bus, or what else becomes of it: it is too old, or cannot be read."""
        topic = self._topics[message.topic_id]
        age_ns = self.clock.delay_ns(message.capture_us, now_ns)
        ttl_ns = topic.name.ttl_ms * _NS_PER_MS
        if ttl_ns and age_ns is not None and age_ns > ttl_ns:
            topic.ledger.expired += 1
            return Outcome.EXPIRED
        capture_unix_ns = self._capture_unix_ns(message)
        try:
            if isinstance(message.read, PayloadError):
                raise message.read
            payload = message.read or topic.reader.read(
                message.payload, self._limits.max_message_bytes, capture_unix_ns
            )
        except PayloadError as error:
            topic.ledger.unreadable += 1
            trouble = topic.trouble.note("unreadable", str(error), now_ns)
            if trouble is not None:
                self._tell(trouble)
            return Outcome.UNREADABLE
        topic.ledger.on_delivered(message.packed_bytes, age_ns)
        return Delivered(
            key=topic.name.key,
            payload=payload.data,
            encoding=payload.type,
            number=number,
            capture_unix_ns=capture_unix_ns,
            one_way_delay_ns=self.clock.delay_ns(message.first_sent_us, now_ns),
            age_ns=age_ns,
            left_ns=ttl_ns - (age_ns or 0) if ttl_ns else FOREVER_NS,
        )

    def _capture_unix_ns(self, message: Arrived) -> int | None:
        unix = self._unix_minus_stamp_ns
        if unix is None:
            return None
        # A host that has just booted without a clock tells of 1970, and of samples from before it.
        return min(max(0, message.capture_us * 1000 + unix), _LATEST_UNIX_NS)

    def _read_in_stream(self, topic: InTopic, message: Arrived, number: int) -> Arrived:
        max_bytes, capture_unix_ns = self._limits.max_message_bytes, self._capture_unix_ns(message)
        read = topic.reader.read_in_stream(message.payload, number, max_bytes, capture_unix_ns)
        return message._replace(read=read)

    def _inbox(self, topic: InTopic, kind: type[AnyInbox]) -> AnyInbox:
        """The inbox of a key: message numbers count per key, whatever the encoding."""
        place = (topic.name.key, kind)
        inbox = self._inboxes.get(place)
        if inbox is None:
            inbox = self._inboxes[place] = self._new_inbox(topic, kind)
        assert isinstance(inbox, kind)
        return inbox

    def _new_inbox(self, topic: InTopic, kind: type[Inbox]) -> Inbox:
        if kind is PlainInbox:
            return PlainInbox(topic.ledger)
        if kind is ReliableInbox:
            next_number = self._settled.topic(topic.name.key).next_number if self._settled else None
            return ReliableInbox(self._waiting_budget, next_number)
        return StateInbox(self._states_budget)

    def _topic_of(self, frame: MessageFrame | SkipFrame) -> InTopic | None:
        topic = self._topics.get(frame.topic_id)
        if frame.name is not None:
            if topic is None and len(self._topics) < self._limits.max_topics:
                topic = self._open(frame.topic_id, frame.name)
            elif topic is None:  # never confirmed, so its frames stay recognisable by their name
                self.refused += 1
                return None
            elif topic.name != frame.name:
                raise DecodeError(f"topic id {frame.topic_id} is {topic.name.key}, not {frame.name.key}")
            self._to_confirm[frame.topic_id] = None
        if topic is None:
            self.unknown_topics += 1
            return None
        if not topic.accepted:
            self.refused += 1
            return None
        return topic

    def _open(self, topic_id: int, name: TopicName) -> InTopic:
        accepted = self._accepts(name.key)
        ledger = self._ledgers.get(name.key, ReceivedLedger())
        if accepted and len(self._ledgers) < self._limits.max_topics:  # lives of the peer have no limit
            self._ledgers[name.key] = ledger
        reader = reader_of(name.key, name.encoding, self._encodings, self._streams)
        topic = InTopic(name, reader, TroubleTeller(name.key), ledger, accepted)
        self._topics[topic_id] = topic
        return topic

    def take_report(self) -> ReportFrame:
        """The report on everything that arrived since the last one."""
        largest, arrival_ns = self._largest_arrival
        earlier = []
        number, number_ns = largest, arrival_ns
        for n, at_ns in sorted(self._arrivals, reverse=True):
            if n >= largest:
                continue
            # Cumulative rounding would drift: each step is the difference of whole microseconds.
            earlier.append((number - n, max(0, number_ns // 1000 - at_ns // 1000)))
            number, number_ns = n, min(at_ns, number_ns)
        self._arrivals.clear()
        self.unreported_since_ns = None
        arrived = self._window.below(largest, ARRIVED_BITS)
        return ReportFrame(self.epoch, largest, arrival_ns // 1000, self.received, tuple(earlier), arrived)

    @property
    def has_unreported(self) -> bool:
        return bool(self._arrivals)

    def take_known(self, max_topics: int) -> KnownFrame:
        """Confirm topics whose names have come."""
        topic_ids = tuple(self._to_confirm)[:max_topics]
        for topic_id in topic_ids:
            del self._to_confirm[topic_id]
        return KnownFrame(self.epoch, topic_ids)

    @property
    def has_to_confirm(self) -> bool:
        return bool(self._to_confirm)

    def take_receipts(self, max_receipts: int) -> tuple[ReceiptFrame, Content]:
        """What became of reliable messages, to be told to their sender."""
        count = min(max_receipts, len(self._receipts))
        receipts = tuple(self._receipts.popleft() for _ in range(count))
        return ReceiptFrame(self.epoch, receipts), _SentReceipts(self, receipts)

    def repeat_receipts(self, receipts: tuple[tuple[int, int, Outcome], ...]) -> None:
        """Receipts were lost on the way."""
        self._receipts.extend(receipts)

    @property
    def has_receipts(self) -> bool:
        return bool(self._receipts)

    def received_rows(self) -> Iterator[tuple[int, ReceivedLedger]]:
        """Counters by the peer's topic ids."""
        return ((i, topic.ledger) for i, topic in self._topics.items() if topic.accepted)

    def key_of(self, topic_id: int) -> str | None:
        """The key that an id of the peer's stands for, if we take it."""
        topic = self._topics.get(topic_id)
        return topic.name.key if topic is not None and topic.accepted else None


def _only_delivered(result: Delivered | Outcome) -> list[Delivered]:
    return [result] if isinstance(result, Delivered) else []

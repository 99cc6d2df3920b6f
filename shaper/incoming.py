"""The receiving half: from the peer's datagrams to messages, and what must be told back."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from shaper.compression import unpack
from shaper.datagram import (
    MESSAGE_NUMBER_BITS,
    NUMBER_BITS,
    Header,
    HelloFrame,
    KnownFrame,
    MessageFrame,
    ReportFrame,
    TopicName,
)
from shaper.errors import DecodeError
from shaper.events import Delivered
from shaper.fragments import Reassembler
from shaper.key_expression import is_key, matches
from shaper.ledger import ReceivedLedger
from shaper.path import PeerClock
from shaper.serial_number import ReceivedWindow, expand, expand_above

_MAX_EARLIER = 40  # arrivals named in one report beside the newest
_LATEST_UNIX_NS = 1 << 62  # the year 2116; leaves room to add ages without leaving 64 bits
_OLD_IN_A_ROW = 3  # so many packets too old to tell and none else: the newest number was a forged one


@dataclass(frozen=True, slots=True)
class Limits:
    """What a peer may make us hold."""

    max_topics: int = 4096
    max_message_bytes: int = 4_000_000
    max_reassembly_bytes: int = 16_000_000
    max_reassembly_wait_ns: int = 60_000_000_000


class _InTopic:
    """One of the peer's topic ids: its name, and which of its message numbers have come."""

    __slots__ = ("accepted", "highest", "ledger", "name", "window")

    def __init__(self, name: TopicName, ledger: ReceivedLedger, accepted: bool) -> None:
        self.name = name
        self.ledger = ledger
        self.accepted = accepted
        self.highest = -1
        self.window = ReceivedWindow(span=256)

    def arrived(self, number_low_bits: int, latest: bool) -> int | None:
        """Count a complete message; its full number, or None if it must not be delivered."""
        if self.highest < 0:  # what came before the first that we hear of is not ours to count
            number = number_low_bits
            self.window.accept(number)
            self.highest = number
            return number
        # A heartbeat wraps its 16 bits in two hours, and a blackout may last as long. Replays end at
        # the packet numbers, so what is older than the window here is a number come round again.
        number = expand_above(number_low_bits, MESSAGE_NUMBER_BITS, self.highest - self.window.span)
        overtaken = number < self.highest
        if not self.window.accept(number):
            return None
        if overtaken:
            self.ledger.lost = max(0, self.ledger.lost - 1)  # it was late, not lost
            if latest:
                self.ledger.stale += 1
                return None
            return number
        self.ledger.lost += number - self.highest - 1
        self.highest = number
        return number


class Incoming:
    """One life of the peer: everything here is forgotten when its epoch changes."""

    def __init__(
        self, epoch: int, limits: Limits, accept: tuple[str, ...], ledgers: dict[str, ReceivedLedger]
    ) -> None:
        self.epoch = epoch
        self.clock = PeerClock()
        self.received = 0
        self.unreported_since_ns: int | None = None
        self.refused = 0
        self.unknown_topics = 0
        self._limits = limits
        self._accept = accept
        self._ledgers = ledgers
        self._window = ReceivedWindow()
        self._old_in_a_row = 0
        self._topics: dict[int, _InTopic] = {}
        self._to_confirm: dict[int, None] = {}
        self._arrivals: deque[tuple[int, int]] = deque(maxlen=_MAX_EARLIER + 1)
        self._largest_arrival = (-1, 0)
        self._unix_minus_stamp_ns: int | None = None
        self._reassembler = Reassembler(
            limits.max_reassembly_bytes, limits.max_message_bytes, limits.max_reassembly_wait_ns
        )

    @property
    def given_up(self) -> int:
        """Fragmented messages that never became whole."""
        return self._reassembler.given_up

    @property
    def held_bytes(self) -> int:
        return self._reassembler.held_bytes

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
        if header.elicits_report and self.unreported_since_ns is None:
            self.unreported_since_ns = now_ns
        return self.clock.expand_stamp(header.stamp_us, now_ns)

    def on_hello(self, frame: HelloFrame, sent_us: int) -> None:
        """Learn the peer's wall clock."""
        if not 0 <= frame.unix_ns <= _LATEST_UNIX_NS:
            raise DecodeError(f"a wall clock of {frame.unix_ns} ns is outside 0..{_LATEST_UNIX_NS}")
        self._unix_minus_stamp_ns = frame.unix_ns - sent_us * 1000

    def on_message(self, frame: MessageFrame, sent_us: int, now_ns: int) -> Delivered | None:
        """Take a message or a part; the message if that completes it and it is still wanted."""
        topic = self._topic_of(frame)
        if topic is None:
            return None
        data, first_sent_ns = frame.data, sent_us * 1000
        if not frame.is_whole:
            whole = self._reassembler.add(
                (frame.topic_id, frame.number), frame.offset, frame.total_bytes, data, first_sent_ns, now_ns
            )
            if whole is None:
                return None
            data, first_sent_ns = whole.data, whole.first_sent_ns
        number = topic.arrived(frame.number, frame.latest)
        if number is None:
            return None
        payload = unpack(data, self._limits.max_message_bytes) if frame.compressed else data
        topic.ledger.delivered += 1
        topic.ledger.received_bytes += len(data)
        return self._delivered(topic.name, payload, number, sent_us - frame.age_us, first_sent_ns, now_ns)

    def _delivered(
        self, name: TopicName, payload: bytes, number: int, capture_us: int, first_sent_ns: int, now_ns: int
    ) -> Delivered:
        unix = self._unix_minus_stamp_ns
        return Delivered(
            key=name.key,
            payload=payload,
            encoding=name.encoding,
            number=number,
            capture_unix_ns=None if unix is None else capture_us * 1000 + unix,
            one_way_delay_ns=self.clock.delay_ns(first_sent_ns // 1000, now_ns),
            age_ns=self.clock.delay_ns(capture_us, now_ns),
        )

    def _topic_of(self, frame: MessageFrame) -> _InTopic | None:
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

    def _open(self, topic_id: int, name: TopicName) -> _InTopic:
        accepted = is_key(name.key) and any(matches(e, name.key) for e in self._accept)
        ledger = self._ledgers.get(name.key, ReceivedLedger())
        if accepted and len(self._ledgers) < self._limits.max_topics:  # lives of the peer have no limit
            self._ledgers[name.key] = ledger
        topic = self._topics[topic_id] = _InTopic(name, ledger, accepted)
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
        return ReportFrame(self.epoch, largest, arrival_ns // 1000, self.received, tuple(earlier))

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

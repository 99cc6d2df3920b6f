"""What our packets met on the way, told by the peer's reports; and how far its clock is from ours."""

from __future__ import annotations

from collections import deque
from typing import NamedTuple, Protocol

from shaper.errors import DecodeError
from shaper.frames import ARRIVED_BITS, NUMBER_BITS, STAMP_BITS, ReportFrame
from shaper.loss import LossMeter
from shaper.serial_number import expand

_MAX_PACKETS_IN_FLIGHT = 1 << 16  # what a heartbeat sends in hours of silence; older ones are forgotten
_EARLIEST_NS = -1_000_000  # a shorter round trip is no rounding or drift but an impossible report
_REORDER_PACKETS = 3  # later packets that may overtake one (RFC 9002, kPacketThreshold)
_INITIAL_RTT_NS = 500_000_000  # until the first report
_GRANULARITY_NS = 10_000_000
_MAX_REPORT_DELAY_NS = 250_000_000  # how long the other side may take to report, at a thin link's rate
_DRIFT_PPM = 200  # how fast two monotonic clocks may part; ageing of an offset sample (quartz: < 100)


class Content(Protocol):
    """Something in a datagram that is worth repeating, or knowing of, when the datagram's fate is known."""

    def on_arrived(self) -> None:
        """The peer has it."""

    def on_lost(self) -> None:
        """It is lost on the link."""


class SentPacket(NamedTuple):
    """A datagram of ours that has left and is not reported on yet."""

    number: int
    sent_ns: int
    wire_bytes: int
    contents: tuple[Content, ...] = ()


class ReportedPacket(NamedTuple):
    """A datagram of ours that is in flight no more.

    arrival_us: in the peer's clock, low 32 bits; None if this report does not tell when, or whether, it
    came.
    """

    number: int
    sent_ns: int
    wire_bytes: int
    arrival_us: int | None


class HeardPacket(NamedTuple):
    """A datagram of the peer's that has come.

    number: its low bits. sent_us: its stamp (expanded). promise_ns: how soon the next one follows at the
    latest. peer_bps: what the peer last took its direction for; 0 if it has told nothing.
    """

    number: int
    sent_us: int
    wire_bytes: int
    promise_ns: int = 0
    peer_bps: int = 0


class PeerClock:
    """The offset of the peer's monotonic clock, from the exchange of stamps.

    Of all exchanges the one with the smallest error bound is kept: half its round trip, plus drift
    since. Right up to half the difference of the two directions' fixed delays, which no exchange of
    stamps can tell apart. Source: the clock filter of NTP (RFC 5905, section 10).
    """

    def __init__(self) -> None:
        self.offset_ns: int | None = None  # peer's clock minus ours
        self._bound_ns = 0
        self._sampled_ns = 0
        self._newest: tuple[int, int] | None = None  # newest stamp (expanded, us) and when it came (ns)

    def expand_stamp(self, stamp_us: int, now_ns: int) -> int:
        """A 32-bit stamp of the peer as a plain count of microseconds since an arbitrary start.

        Told apart by how long ago the one before it came, so that silence may last for hours.
        """
        last_us, last_ns = (stamp_us, now_ns) if self._newest is None else self._newest
        expanded = expand(stamp_us, STAMP_BITS, last_us + (now_ns - last_ns) // 1000)
        self._newest = expanded, now_ns
        return expanded

    def on_exchange(
        self, sent_ns: int, peer_received_us: int, peer_sent_us: int, received_ns: int
    ) -> int | None:
        """Learn from one exchange of stamps (peer stamps expanded).

        Returns its round-trip time in ns; None, and learns nothing, if the stamps contradict each other.
        """
        rtt_ns = (received_ns - sent_ns) - (peer_sent_us - peer_received_us) * 1000
        if rtt_ns < _EARLIEST_NS:
            return None
        bound_ns = max(0, rtt_ns) // 2
        aged_ns = self._bound_ns + (received_ns - self._sampled_ns) * _DRIFT_PPM // 1_000_000
        if self.offset_ns is None or bound_ns <= aged_ns:
            self.offset_ns = ((peer_received_us + peer_sent_us) * 1000 - sent_ns - received_ns) // 2
            self._bound_ns, self._sampled_ns = bound_ns, received_ns
        return rtt_ns

    def age_ns(self, stamp_us: int, now_ns: int) -> int | None:
        """Age of what the peer stamped of late with the low bits of its clock (us); None if unknown."""
        if self.offset_ns is None:
            return None
        now_there_us = (now_ns + self.offset_ns) // 1000
        return (now_there_us - expand(stamp_us, STAMP_BITS, now_there_us)) * 1000

    def delay_ns(self, peer_sent_us: int, received_ns: int) -> int | None:
        """One-way delay of something the peer stamped (expanded) and we received; None if unknown."""
        if self.offset_ns is None:
            return None
        return received_ns + self.offset_ns - peer_sent_us * 1000


class Path:
    """Packets in flight, round-trip time and loss of our sending direction.

    In flight is what was sent after the newest packet that the peer has reported: on a link that keeps
    the order, everything before it has arrived or is lost. Which of the two is settled with patience for
    packets that overtake: lost is what is missing in a report although three later packets have arrived,
    or although it left more than 9/8 of a round trip ago (RFC 9002, section 6.1).
    """

    def __init__(self) -> None:
        self.next_number = 0
        self.bytes_in_flight = 0
        self.rtt_ns: int | None = None
        self.smoothed_rtt_ns = _INITIAL_RTT_NS
        self.rtt_variation_ns = _INITIAL_RTT_NS // 2
        self._loss = LossMeter()
        self.lost_packets = 0
        self.lost_bytes = 0
        self.reported = False  # whether the peer has ever reported on this epoch of ours
        self._in_flight: deque[SentPacket] = deque()
        self._missing: dict[int, SentPacket] = {}  # in flight no more, but not known to have arrived
        self._largest = -1
        self._judged_lost: dict[int, SentPacket] = {}  # lately; what was only late may yet be reported
        self._counts_from = 0  # what left before the peer was there is lost, but says nothing of the link

    @property
    def loss_ratio(self) -> float:
        """Of the packets that were settled lately, those that never came; 0..1."""
        return self._loss.ratio

    def on_sent(self, wire_bytes: int, now_ns: int, contents: tuple[Content, ...] = ()) -> SentPacket:
        """Number and remember a datagram that leaves now."""
        packet = SentPacket(self.next_number, now_ns, wire_bytes, contents)
        self.next_number += 1
        self._in_flight.append(packet)
        self.bytes_in_flight += wire_bytes
        if len(self._in_flight) > _MAX_PACKETS_IN_FLIGHT:
            forgotten = self._in_flight.popleft()
            self.bytes_in_flight -= forgotten.wire_bytes
            self._lose(forgotten)
        return packet

    def on_peer_restarted(self) -> None:
        """The peer counts anew; what was in flight to its former self is gone."""
        self._in_flight.clear()
        self._missing.clear()
        self._judged_lost.clear()
        self.bytes_in_flight = 0
        self.reported = False

    def probe_timeout_ns(self) -> int:
        """How long to wait for a report before asking for one (RFC 9002, section 6.2.1)."""
        variation_ns = max(4 * self.rtt_variation_ns, _GRANULARITY_NS)
        return self.smoothed_rtt_ns + variation_ns + _MAX_REPORT_DELAY_NS

    def on_report(
        self, report: ReportFrame, report_sent_us: int, clock: PeerClock, now_ns: int
    ) -> list[ReportedPacket]:
        """The packets that this report takes out of flight, oldest first; none if it says nothing new.

        Raises DecodeError for a report on packets that were never sent.
        """
        largest = expand(report.largest, NUMBER_BITS, self.next_number - 1)
        if largest >= self.next_number:
            raise DecodeError(f"a report names packet {largest}, of {self.next_number} sent")
        if largest <= self._largest:
            return []
        arrivals = {largest: report.arrival_us}
        number, arrival_us = largest, report.arrival_us
        for numbers_before, us_before in report.earlier:
            number -= numbers_before
            arrival_us -= us_before
            arrivals[number] = arrival_us & 0xFFFF_FFFF
        settled, sent_largest_ns = self._settle(largest, arrivals)
        if sent_largest_ns is not None:
            peer_received_us = expand(report.arrival_us, STAMP_BITS, report_sent_us)
            rtt_ns = clock.on_exchange(sent_largest_ns, peer_received_us, report_sent_us, now_ns)
            if rtt_ns is not None:
                self._update_rtt(rtt_ns)
        self._largest = largest
        if not self.reported:
            self._counts_from = largest
            self.reported = True
        self._judge_missing(largest, arrivals, report.arrived, now_ns)
        return settled

    def _settle(self, largest: int, arrivals: dict[int, int]) -> tuple[list[ReportedPacket], int | None]:
        settled, sent_largest_ns = [], None
        while self._in_flight and self._in_flight[0].number <= largest:
            sent = self._in_flight.popleft()
            self.bytes_in_flight -= sent.wire_bytes
            self._missing[sent.number] = sent
            arrival_us = arrivals.get(sent.number)
            settled.append(ReportedPacket(sent.number, sent.sent_ns, sent.wire_bytes, arrival_us))
            if sent.number == largest:
                sent_largest_ns = sent.sent_ns
        return settled, sent_largest_ns

    def _judge_missing(self, largest: int, arrivals: dict[int, int], arrived: bytes, now_ns: int) -> None:
        """Arrived, lost, or too early to say."""
        bits = int.from_bytes(arrived, "little") if arrived else (1 << ARRIVED_BITS) - 1
        self._take_back(largest, bits)
        patience_ns = max(self.smoothed_rtt_ns, self.rtt_ns or 0) * 9 // 8
        for number, sent in list(self._missing.items()):
            behind = largest - number
            known = behind == 0 or number in arrivals or (behind <= ARRIVED_BITS and bits >> behind - 1 & 1)
            if known:
                del self._missing[number]
                self._loss.on_settled(lost=False)
                for content in sent.contents:
                    content.on_arrived()
            elif behind >= _REORDER_PACKETS or sent.sent_ns < now_ns - patience_ns:
                del self._missing[number]
                if number >= self._counts_from:
                    self._loss.on_settled(lost=True)
                    self._judged_lost[number] = sent
                self._lose(sent)

    def _take_back(self, largest: int, bits: int) -> None:
        """What was judged lost and has come after all is no loss of the link."""
        for number, sent in list(self._judged_lost.items()):
            behind = largest - number
            if behind > ARRIVED_BITS:
                del self._judged_lost[number]
            elif bits >> behind - 1 & 1:
                del self._judged_lost[number]
                self._loss.on_came_after_all()
                self.lost_packets -= 1
                self.lost_bytes -= sent.wire_bytes

    def _lose(self, sent: SentPacket) -> None:
        self.lost_packets += 1
        self.lost_bytes += sent.wire_bytes
        for content in sent.contents:
            content.on_lost()

    def _update_rtt(self, rtt_ns: int) -> None:
        """Smoothing of RFC 9002, section 5.3."""
        if self.rtt_ns is None:
            self.smoothed_rtt_ns, self.rtt_variation_ns = rtt_ns, rtt_ns // 2
        else:
            self.rtt_variation_ns += (abs(self.smoothed_rtt_ns - rtt_ns) - self.rtt_variation_ns) // 4
            self.smoothed_rtt_ns += (rtt_ns - self.smoothed_rtt_ns) // 8
        self.rtt_ns = rtt_ns

"""What our packets met on the way, told by the peer's reports; and how far its clock is from ours."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from shaper.datagram import NUMBER_BITS, STAMP_BITS, ReportFrame
from shaper.errors import DecodeError
from shaper.serial_number import expand

_MAX_PACKETS_IN_FLIGHT = 1 << 16  # what a heartbeat sends in hours of silence; older ones are forgotten
_EARLIEST_NS = -1_000_000  # a shorter round trip is no rounding or drift but an impossible report
_LOSS_WINDOW_PACKETS = 200  # loss is averaged over about this many packets
_DRIFT_PPM = 200  # how fast two monotonic clocks may part; ageing of an offset sample (quartz: < 100)


@dataclass(frozen=True, slots=True)
class SentPacket:
    """A datagram of ours that has left and is not reported on yet."""

    number: int
    sent_ns: int
    wire_bytes: int


@dataclass(frozen=True, slots=True)
class ReportedPacket:
    """A datagram of ours and what became of it.

    arrival_us: in the peer's clock, low 32 bits; None if it did not arrive before later ones did.
    """

    number: int
    sent_ns: int
    wire_bytes: int
    arrival_us: int | None


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

    def delay_ns(self, peer_sent_us: int, received_ns: int) -> int | None:
        """One-way delay of something the peer stamped (expanded) and we received; None if unknown."""
        if self.offset_ns is None:
            return None
        return received_ns + self.offset_ns - peer_sent_us * 1000


class Path:
    """Packets in flight, round-trip time and loss of our sending direction.

    In flight is what was sent after the newest packet that the peer has reported: on a link that
    keeps the order, everything before it has arrived or is lost.
    """

    def __init__(self) -> None:
        self.next_number = 0
        self.bytes_in_flight = 0
        self.rtt_ns: int | None = None
        self.loss_ratio = 0.0
        self.reported = False  # whether the peer has ever reported on this epoch of ours
        self._in_flight: deque[SentPacket] = deque()
        self._largest = -1
        self._last_received: int | None = None

    def on_sent(self, wire_bytes: int, now_ns: int) -> SentPacket:
        """Number and remember a datagram that leaves now."""
        packet = SentPacket(self.next_number, now_ns, wire_bytes)
        self.next_number += 1
        self._in_flight.append(packet)
        self.bytes_in_flight += wire_bytes
        if len(self._in_flight) > _MAX_PACKETS_IN_FLIGHT:
            self.bytes_in_flight -= self._in_flight.popleft().wire_bytes
        return packet

    def on_peer_restarted(self) -> None:
        """The peer counts anew; what was in flight to its former self is gone."""
        self._in_flight.clear()
        self.bytes_in_flight = 0
        self.reported = False
        self._last_received = None

    def on_report(
        self, report: ReportFrame, report_sent_us: int, clock: PeerClock, now_ns: int
    ) -> list[ReportedPacket]:
        """The packets that this report settles, oldest first; none if it says nothing new.

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
        settled = self._settle(largest, arrivals)
        if settled and settled[-1].number == largest:
            peer_received_us = expand(report.arrival_us, STAMP_BITS, report_sent_us)
            rtt_ns = clock.on_exchange(settled[-1].sent_ns, peer_received_us, report_sent_us, now_ns)
            self.rtt_ns = self.rtt_ns if rtt_ns is None else rtt_ns
        self._update_loss(largest, report.received)
        self._largest = largest
        self.reported = True
        return settled

    def _settle(self, largest: int, arrivals: dict[int, int]) -> list[ReportedPacket]:
        settled = []
        while self._in_flight and self._in_flight[0].number <= largest:
            sent = self._in_flight.popleft()
            self.bytes_in_flight -= sent.wire_bytes
            settled.append(
                ReportedPacket(sent.number, sent.sent_ns, sent.wire_bytes, arrivals.get(sent.number))
            )
        return settled

    def _update_loss(self, largest: int, received: int) -> None:
        if self._last_received is not None:
            passed = largest - self._largest
            arrived = (received - self._last_received) & 0xFFFF_FFFF
            if arrived <= passed:
                weight = min(1.0, passed / _LOSS_WINDOW_PACKETS)
                self.loss_ratio += weight * ((passed - arrived) / passed - self.loss_ratio)
        self._last_received = received

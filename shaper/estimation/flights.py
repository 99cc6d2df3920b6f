"""What has been sent: when, behind how much queue, and when it arrived if that is known."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from itertools import islice, takewhile

from shaper.frames import STAMP_BITS
from shaper.path import ReportedPacket
from shaper.serial_number import expand

_REMEMBERED = 64  # arrivals that the estimate looks back on
_MOST = 8192  # flights held while nothing is reported: hours of a trickle


class Flight:
    """A datagram. wait_ns: queue that it is taken to have met; arrived_ns: in the peer's clock.

    bits_before: of the channel's own datagrams, which nobody reports on, since the flight before this one.
    """

    __slots__ = ("arrived_ns", "bits", "bits_before", "number", "sent_ns", "wait_ns")

    def __init__(self, number: int, sent_ns: int, bits: int, wait_ns: int, bits_before: int = 0) -> None:
        self.number = number
        self.sent_ns = sent_ns
        self.bits = bits
        self.bits_before = bits_before
        self.wait_ns = wait_ns
        self.arrived_ns: int | None = None

    def delay_ns(self, rate_bps: float) -> int:
        """One-way delay without the datagram's own serialisation, plus the offset of the peer's clock."""
        assert self.arrived_ns is not None, "only what has arrived has a delay"
        return self.arrived_ns - self.sent_ns - int(self.bits * 1e9 / rate_bps)


class Flights:
    """The last arrivals and everything that is in flight, oldest first."""

    def __init__(self) -> None:
        self.acked: deque[Flight] = deque(maxlen=_REMEMBERED)
        self.unreported: deque[Flight] = deque(maxlen=_MOST)
        self._offset_us = 0  # of the newest arrival stamp (expanded) from our clock

    def on_sent(self, number: int, bits: int, wait_ns: int, now_ns: int, bits_before: int = 0) -> None:
        """A datagram has left."""
        self.unreported.append(Flight(number, now_ns, bits, wait_ns, bits_before))

    def on_report(self, settled: Sequence[ReportedPacket]) -> list[Flight]:
        """Those that have arrived, oldest first; what is lost, or of unknown arrival, is forgotten."""
        arrived: list[Flight] = []
        for packet in settled:
            while self.unreported and self.unreported[0].number < packet.number:
                self.unreported.popleft()
            if not self.unreported or self.unreported[0].number != packet.number:
                continue
            flight = self.unreported.popleft()
            if packet.arrival_us is None:
                continue
            near_us = flight.sent_ns // 1000 + self._offset_us
            arrival_us = expand(packet.arrival_us, STAMP_BITS, near_us)
            self._offset_us = arrival_us - flight.sent_ns // 1000
            flight.arrived_ns = arrival_us * 1000
            self.acked.append(flight)
            arrived.append(flight)
        return arrived

    def least_late(self, count: int, rate_bps: float) -> Flight:
        """Of the newest arrivals (there is one), the one whose delay exceeds its computed wait by least."""
        newest = islice(reversed(self.acked), count)
        return min(newest, key=lambda flight: flight.delay_ns(rate_bps) - flight.wait_ns)

    def bits_in_flight(self) -> int:
        """All that may still be queued."""
        return sum(flight.bits + flight.bits_before for flight in self.unreported)

    def bits_since(self, sent_ns: int) -> int:
        """What of it left at this time or later."""
        later = takewhile(lambda flight: flight.sent_ns >= sent_ns, reversed(self.unreported))
        return sum(flight.bits + flight.bits_before for flight in later)

    def most_queue_ns(self, rate_bps: float) -> int:
        """What is not reported yet is all that the link can hold; a full buffer has dropped the rest."""
        return int(self.bits_in_flight() * 1e9 / rate_bps)

    def hold_from_before(self, sent_ns: int) -> bool:
        """Whether something that left before then is in flight."""
        return len(self.unreported) > 0 and self.unreported[0].sent_ns < sent_ns

    def simulate(self, rate_bps: float, begin: Flight, wait_ns: int, now_ns: int) -> int:
        """The queue now (ns), if one flight met `wait_ns` of it and the link serves this rate since.

        Rewrites what the later flights are taken to have met.
        """
        per_bit_ns = 1e9 / rate_bps
        begin.wait_ns = wait_ns
        empty_ns = begin.sent_ns + wait_ns + int(begin.bits * per_bit_ns)
        number = begin.number
        later = list(takewhile(lambda flight: flight.number > number, reversed(self.acked)))
        for flights in (reversed(later), self.unreported):
            for flight in flights:
                if flight.number <= number:
                    continue
                sent_ns = flight.sent_ns
                start_ns = empty_ns if empty_ns > sent_ns else sent_ns
                if flight.bits_before:
                    start_ns += int(flight.bits_before * per_bit_ns)
                flight.wait_ns = start_ns - sent_ns
                empty_ns = start_ns + int(flight.bits * per_bit_ns)
        return max(0, empty_ns - now_ns)

    def count_since(self, sent_ns: int) -> int:
        """How many that left at this time or later are in flight."""
        return sum(1 for _ in takewhile(lambda flight: flight.sent_ns >= sent_ns, reversed(self.unreported)))

    def first_since(self, sent_ns: int) -> Flight | None:
        """The oldest remembered flight that left at this time or later."""
        for flights in (self.acked, self.unreported):
            for flight in flights:
                if flight.sent_ns >= sent_ns:
                    return flight
        return None

"""Both directions of a link in real time: packets enter, and leave when the link says."""

from __future__ import annotations

import asyncio
import random
import selectors
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from heapq import heappop, heappush

from .band import Profile
from .chance import with_flipped_bit
from .link import Link
from .records import BandRecord, Direction, PacketRecord


@dataclass(slots=True)
class LinkCounts:
    """Packets of one direction.

    received = dropped_by_link + (sent - duplicated) + undeliverable + still waiting at the stop. Packets that
    the kernel threw away were never received: kernel_drops above 0 means that the numbers of this run are not
    the link's. undeliverable: the kernel refused it, or nobody had spoken from there yet. corrupted: of those
    sent, with a flipped bit. worst_lateness_ns: how far behind the link's instant a packet was sent.
    """

    received: int = 0
    dropped_by_link: int = 0
    duplicated: int = 0
    sent: int = 0
    undeliverable: int = 0
    kernel_drops: int = 0
    worst_lateness_ns: int = 0
    corrupted: int = 0


@dataclass(frozen=True, slots=True)
class LinkReport:
    """What went through, per direction."""

    down: LinkCounts
    up: LinkCounts


def precise_event_loop() -> asyncio.AbstractEventLoop:
    """A loop whose timers count microseconds: asyncio.Runner(loop_factory=precise_event_loop).

    The usual one waits in epoll, in whole milliseconds rounded up twice, and is up to 2 ms late.
    """
    return asyncio.SelectorEventLoop(selectors.SelectSelector())


@dataclass(slots=True)
class Way:
    """One direction. deliver hands a packet to the far end; False or OSError: it could not."""

    direction: Direction
    link: Link
    deliver: Callable[[bytes], bool]
    counts: LinkCounts = field(default_factory=LinkCounts)


class Carrier:
    """Holds what is in the link and delivers it in time, on the running event loop."""

    def __init__(
        self,
        profile: Profile,
        seed: int,
        deliver_down: Callable[[bytes], bool],
        deliver_up: Callable[[bytes], bool],
        on_packet: Callable[[PacketRecord], None] | None = None,
        on_band: Callable[[BandRecord], None] | None = None,
    ) -> None:
        self.down = Way("down", Link(profile.down, random.Random(f"{seed} down")), deliver_down)
        self.up = Way("up", Link(profile.up, random.Random(f"{seed} up")), deliver_up)
        self._on_packet = on_packet
        self._on_band = on_band
        self._loop = asyncio.get_running_loop()
        self._start_ns = 0
        self._due: list[tuple[int, int, Way, bytes]] = []  # heap: arrival_ns, serial, ...
        self._serial = 0
        self._timer: asyncio.TimerHandle | None = None
        self._timer_at_ns = 0
        self._band_timers: dict[Direction, asyncio.TimerHandle] = {}

    def start(self) -> None:
        """The schedule begins now."""
        self._start_ns = time.monotonic_ns()
        for way in (self.down, self.up):
            self._announce_band(way, 0)

    def close(self) -> None:
        """What is still in the link is gone."""
        for timer in (self._timer, *self._band_timers.values()):
            if timer is not None:
                timer.cancel()

    def report(self) -> LinkReport:
        """The counts so far."""
        return LinkReport(self.down.counts, self.up.counts)

    def enter(self, way: Way, data: bytes, now_ns: int, header_bytes: int = 0) -> None:
        """A packet has come at now_ns (time.monotonic_ns).

        header_bytes: how many of data are headers that the profile's overhead already counts.
        """
        passage = way.link.transmit(len(data) - header_bytes, now_ns - self._start_ns)
        counts = way.counts
        counts.received += 1
        counts.dropped_by_link += not passage.arrivals_ns
        counts.duplicated += len(passage.arrivals_ns) > 1
        if passage.corrupted_bit is not None:
            counts.corrupted += 1
            data = with_flipped_bit(data, 8 * header_bytes + passage.corrupted_bit)
        for arrival_ns in passage.arrivals_ns:
            heappush(self._due, (self._start_ns + arrival_ns, self._serial, way, data))
            self._serial += 1
        if self._on_packet is not None:
            self._on_packet(
                PacketRecord(
                    t_ns=now_ns,
                    direction=way.direction,
                    wire_bytes=passage.wire_bytes,
                    queue_delay_ns=passage.queue_delay_ns,
                    dropped=passage.drop,
                )
            )

    def deliver_due(self) -> None:
        """Send what is due and set the timer for what is due next."""
        due = self._due
        while due and due[0][0] <= time.monotonic_ns():
            arrival_ns, _, way, data = heappop(due)
            self._deliver(way, data)
            late_ns = time.monotonic_ns() - arrival_ns
            way.counts.worst_lateness_ns = max(way.counts.worst_lateness_ns, late_ns)
        if due and (self._timer is None or due[0][0] != self._timer_at_ns):
            if self._timer is not None:
                self._timer.cancel()
            self._timer_at_ns = due[0][0]
            self._timer = self._loop.call_at(self._timer_at_ns / 1e9, self._on_timer)

    def _deliver(self, way: Way, data: bytes) -> None:
        try:
            delivered = way.deliver(data)
        except OSError:  # a full send buffer, no route, too long: counted, as it is not the link's doing
            delivered = False
        way.counts.sent += delivered
        way.counts.undeliverable += not delivered

    def _on_timer(self) -> None:
        self._timer = None
        self.deliver_due()

    def _announce_band(self, way: Way, at_ns: int) -> None:
        band = way.link.band_at(at_ns)
        if self._on_band is not None:
            self._on_band(
                BandRecord(self._start_ns + at_ns, way.direction, band.rate_bps, band.one_way_delay_ns)
            )
        change_ns = way.link.next_change_ns(at_ns)
        if change_ns is not None:
            at_s = (self._start_ns + change_ns) / 1e9
            timer = self._loop.call_at(at_s, self._announce_band, way, change_ns)
            self._band_timers[way.direction] = timer

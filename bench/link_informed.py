"""The best that anybody could do: a sender that is told the truth as soon as a datagram could carry it.

It knows the link's model, its own queue to the bit, and each band from the moment on at which news of it
can have come: by what has arrived there when the peer spoke, or, where both directions change at once, by
the way back. It needs no measurement, no trains and no patience with noise, and cannot foresee. It shows what
perfect measuring would be worth; one that guesses at a change, and is right, may use more of the link.
"""

from __future__ import annotations

import random
from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

from bench.link_score import spans_of
from netem_scripts.band import Band, DirectionProfile, Profile
from netem_scripts.link import Link
from shaper.estimation.adaptive import ALLOWANCE_NS
from shaper.estimation.sizes import full_bytes
from shaper.estimation.virtual_queue import VirtualQueue
from shaper.link_estimator import EstimatorFactory, PresetBand
from shaper.path import HeardPacket, ReportedPacket, SentPacket

_MAX_WIRE_BYTES = 1228
_STAMP = 1 << 32
_NEVER_NS = 1 << 62
_NO_LIMIT_BYTES = 1 << 40


class Informed:
    """One direction's sender. Both hosts' clocks must show true time.

    guesses: whether it knows at once what our direction has become when the way back tells that something
    has changed; else it holds until one of its own datagrams could tell.
    """

    def __init__(
        self,
        ours: DirectionProfile,
        theirs: DirectionProfile,
        duration_ns: int,
        now_ns: int,
        *,
        guesses: bool,
    ) -> None:
        self._bands = spans_of(ours, duration_ns)
        self.rate_bps = self._bands[0][2].rate_bps
        self.pacer = VirtualQueue(self.rate_bps, ALLOWANCE_NS, now_ns)
        self.trickles, self.band, self.confidence, self.loss_ratio = True, "", 1.0, 0.0
        self.in_flight_limit_bytes = _NO_LIMIT_BYTES
        self._ours = _without_loss(ours)
        self._began_ns, self._guesses = now_ns, guesses
        self._link = Link(self._ours, random.Random(0))
        self._sent: list[tuple[int, int]] = []  # when, and bytes on the wire
        self._fates: deque[tuple[int, int]] = deque()  # arrival, and when the link had served it
        self._starts_ns = [begin_ns for begin_ns, _, _ in self._bands]
        self._known = 0  # the band that it knows of
        self._news = deque(_news(self._starts_ns[1:], theirs, duration_ns))

    @property
    def datagram_bytes(self) -> int:
        return full_bytes(self.rate_bps, _MAX_WIRE_BYTES)

    @property
    def queue_ns(self) -> int:
        return self.pacer.level_ns

    def probe_bytes(self, now_ns: int) -> int:
        return 0

    def on_peer_restarted(self, now_ns: int) -> None:
        """Nothing to forget."""

    def on_report(
        self, settled: Sequence[ReportedPacket], rtt_ns: int | None, loss_ratio: float, now_ns: int
    ) -> None:
        self.loss_ratio = loss_ratio

    def on_sent(self, packet: SentPacket, now_ns: int) -> None:
        at_ns = now_ns - self._began_ns
        self._sent.append((at_ns, packet.wire_bytes))
        passage = self._link.transmit(packet.wire_bytes - self._ours.overhead_bytes, at_ns)
        if passage.departure_ns is not None and passage.arrivals_ns:
            self._fates.append((passage.arrivals_ns[0], passage.departure_ns))

    def on_heard(self, packet: HeardPacket, now_ns: int) -> None:
        delay_us = (now_ns // 1000 - packet.sent_us + _STAMP // 2) % _STAMP - _STAMP // 2
        spoke_ns = now_ns - self._began_ns - delay_us * 1000
        served_ns = -1
        while self._fates and self._fates[0][0] <= spoke_ns:
            served_ns = self._fates.popleft()[1]
        if served_ns >= 0:
            self._learn(bisect_right(self._starts_ns, served_ns) - 1, now_ns)

    def wakeup_at_ns(self) -> int | None:
        return self._began_ns + self._news[0][0] if self._news else None

    def on_timer(self, now_ns: int) -> None:
        while self._news and self._news[0][0] <= now_ns - self._began_ns:
            band = self._news.popleft()[1]
            if self._guesses:
                self._learn(band, now_ns)
            elif band > self._known:
                self.pacer.not_before_ns = _NEVER_NS
                self.pacer.free = 1  # which can tell, if nothing else is on its way

    def _learn(self, band: int, now_ns: int) -> None:
        if band <= self._known:
            return
        self._known = band
        self.rate_bps = self._bands[band][2].rate_bps
        at_ns = now_ns - self._began_ns
        self.pacer.set(self.rate_bps, max(0, self._empty_ns(band) - at_ns), now_ns)
        self.pacer.not_before_ns, self.pacer.free = now_ns, 0

    def _empty_ns(self, band: int) -> int:
        """When the link will have served all, should no other band follow."""
        past: list[Band] = [replace(b, duration_ns=end - begin) for begin, end, b in self._bands[: band + 1]]
        link, empty_ns = Link(replace(self._ours, bands=tuple(past), cyclic=False), random.Random(0)), 0
        for at_ns, wire_bytes in self._sent:
            passage = link.transmit(wire_bytes - self._ours.overhead_bytes, at_ns)
            empty_ns = max(empty_ns, passage.departure_ns or 0)
        return empty_ns


def informed(profile: Profile, duration_ns: int, *, guesses: bool) -> EstimatorFactory:
    """Makes the robot's and then the operator's, in the order in which a mission asks."""
    ways = iter(((profile.down, profile.up), (profile.up, profile.down)))

    def make(bands: Sequence[PresetBand], now_ns: int) -> Informed:
        return Informed(*next(ways), duration_ns, now_ns, guesses=guesses)

    return make


def _without_loss(direction: DirectionProfile) -> DirectionProfile:
    """What is lost carries no news; what arrives in its place at about the same time does."""
    bands = tuple(replace(b, loss_ratio=0.0, jitter_ns=0, duplicate_ratio=0.0) for b in direction.bands)
    return replace(direction, bands=bands)


def _news(changes_ns: list[int], theirs: DirectionProfile, duration_ns: int) -> list[tuple[int, int]]:
    """When the way back tells of changes of ours that it shares, and the bands that they begin."""
    back = spans_of(theirs, duration_ns)
    delay_before_ns = {begin: before[2].one_way_delay_ns for before, (begin, _, _) in pairwise(back)}
    return [
        (at_ns + delay_before_ns[at_ns], number)
        for number, at_ns in enumerate(changes_ns, 1)
        if at_ns in delay_before_ns
    ]

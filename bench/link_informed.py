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
from typing import NamedTuple

from bench.link_score import NS_PER_S, spans_of
from netem_scripts.band import Band, DirectionProfile, Profile
from netem_scripts.link import Link
from shaper.estimation.adaptive import ALLOWANCE_NS, START_BPS
from shaper.estimation.silence import HICCUPS, Silence
from shaper.estimation.sizes import TRAIN_BYTES, full_bytes
from shaper.estimation.trains import TRAIN_DATAGRAMS
from shaper.estimation.virtual_queue import VirtualQueue
from shaper.link_estimator import EstimatorFactory, PresetBand
from shaper.path import HeardPacket, ReportedPacket, SentPacket

_MAX_WIRE_BYTES = 1228
_STAMP = 1 << 32
_NEVER_NS = 1 << 62
_TRAINS_NS = 50_000_000  # between those of the measuring one
_NO_LIMIT_BYTES = 1 << 40


class _Fate(NamedTuple):
    """Of a datagram: when it arrived, when the link had served it, and whether it had to wait for that."""

    arrived_ns: int
    served_ns: int
    queued: bool


class Informed:
    """One direction's sender. Both hosts' clocks must show true time.

    guesses: whether it knows at once what our direction has become when the way back tells that something
    has changed; else it holds until one of its own datagrams could tell.
    """

    _asks = 1  # datagrams that leave to tell what a change has brought

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
        self._fates: deque[_Fate] = deque()
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
            self._fates.append(
                _Fate(passage.arrivals_ns[0], passage.departure_ns, passage.queue_delay_ns > 0)
            )

    def on_heard(self, packet: HeardPacket, now_ns: int) -> None:
        delay_us = (now_ns // 1000 - packet.sent_us + _STAMP // 2) % _STAMP - _STAMP // 2
        spoke_ns = now_ns - self._began_ns - delay_us * 1000
        while self._fates and self._fates[0].arrived_ns <= spoke_ns:
            self._on_fate(self._fates.popleft(), now_ns)

    def _on_fate(self, fate: _Fate, now_ns: int) -> None:
        """The peer can have told of a datagram of ours."""
        self._learn(self._band_at(fate.served_ns), now_ns)

    def _band_at(self, served_ns: int) -> int:
        return bisect_right(self._starts_ns, served_ns) - 1

    def wakeup_at_ns(self) -> int | None:
        return self._began_ns + self._news[0][0] if self._news else None

    def on_timer(self, now_ns: int) -> None:
        while self._news and self._news[0][0] <= now_ns - self._began_ns:
            band = self._news.popleft()[1]
            if self._guesses:
                self._learn(band, now_ns)
            elif band > self._known:
                self.pacer.not_before_ns = _NEVER_NS
                self.pacer.free = self._asks  # which can tell, if nothing else is on its way

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


class Measuring(Informed):
    """Told, as the informed one is, of what has changed when there is word of it, but not of the rate.

    A rate is known by the report of two datagrams that the link has served one behind the other in that
    band: after a rise, of a train that leaves when there is word; trains follow each other every 50 ms until
    one is reported. Where datagrams are lost, silence is no news before as many have failed to come as ours
    waits for.
    """

    _asks = TRAIN_DATAGRAMS

    def __init__(
        self, ours: DirectionProfile, theirs: DirectionProfile, duration_ns: int, now_ns: int
    ) -> None:
        super().__init__(ours, theirs, duration_ns, now_ns, guesses=False)
        self._news = deque(_news(self._starts_ns[1:], theirs, duration_ns, patient=True))
        self._known = self._suspected = -1
        self.rate_bps = START_BPS
        self.pacer.set(START_BPS, 0, now_ns)
        self._by_number: dict[int, _Fate] = {}
        self._last = -2, 0  # the newest one reported: its number, and when the link had served it
        self._again_ns = _NEVER_NS  # when the next train leaves

    def probe_bytes(self, now_ns: int) -> int:
        return TRAIN_BYTES if self.pacer.free else 0

    def on_sent(self, packet: SentPacket, now_ns: int) -> None:
        before = len(self._fates)
        super().on_sent(packet, now_ns)
        if len(self._fates) > before:
            self._by_number[packet.number] = self._fates[-1]

    def on_heard(self, packet: HeardPacket, now_ns: int) -> None:
        if self._suspected < 0:
            self._suspect(0, now_ns)

    def on_report(
        self, settled: Sequence[ReportedPacket], rtt_ns: int | None, loss_ratio: float, now_ns: int
    ) -> None:
        self.loss_ratio = loss_ratio
        for packet in settled:
            fate = self._by_number.pop(packet.number, None)
            if packet.arrival_us is None or fate is None:
                continue
            band = self._band_at(fate.served_ns)
            number, served_ns = self._last
            self._last = packet.number, fate.served_ns
            if fate.queued and packet.number == number + 1 and band == self._band_at(served_ns):
                if band >= self._suspected:
                    self._again_ns = _NEVER_NS
                self._learn(band, now_ns)
            elif band > max(self._known, self._suspected):
                self._suspect(band, now_ns)

    def wakeup_at_ns(self) -> int | None:
        news_ns = super().wakeup_at_ns()
        return min(self._again_ns, _NEVER_NS if news_ns is None else news_ns)

    def on_timer(self, now_ns: int) -> None:
        super().on_timer(now_ns)
        if now_ns >= self._again_ns:
            self.pacer.free = self._asks
            self._again_ns = now_ns + _TRAINS_NS

    def _suspect(self, band: int, now_ns: int) -> None:
        self._suspected = band
        self.pacer.free = self._asks
        self._again_ns = now_ns + _TRAINS_NS
        if self._bands[band][2].rate_bps < self.rate_bps:
            self.pacer.not_before_ns = _NEVER_NS
        else:
            self.pacer.not_before_ns = now_ns


def measuring(profile: Profile, duration_ns: int) -> EstimatorFactory:
    """Makes the robot's and then the operator's, in the order in which a mission asks."""
    ways = iter(((profile.down, profile.up), (profile.up, profile.down)))
    return lambda bands, now_ns: Measuring(*next(ways), duration_ns, now_ns)


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


def _news(
    changes_ns: list[int], theirs: DirectionProfile, duration_ns: int, *, patient: bool = False
) -> list[tuple[int, int]]:
    """When the way back tells of changes of ours that it shares, and the bands that they begin.

    patient: where it falls silent, by as many of the peer's full datagrams as loss does not explain.
    """
    back, news = spans_of(theirs, duration_ns), {}
    for (_, _, before), (begin_ns, _, after) in pairwise(back):
        news[begin_ns] = begin_ns + before.one_way_delay_ns
        if patient and after.one_way_delay_ns > before.one_way_delay_ns:
            misses = Silence().needed_misses(before.loss_ratio, HICCUPS)
            bits = 8 * full_bytes(before.rate_bps, _MAX_WIRE_BYTES)
            news[begin_ns] += (misses - 1) * bits * NS_PER_S // before.rate_bps
    return [(news[at_ns], number) for number, at_ns in enumerate(changes_ns, 1) if at_ns in news]

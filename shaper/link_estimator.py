"""What the link carries: the interface of an estimator, and the preset bands as the first one."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from shaper.pacer import Pacer, Pacing
from shaper.path import HeardPacket, ReportedPacket, SentPacket

_RTT_MEMORY_NS = 200_000_000  # newest round trips that are compared; a single late one changes no band
_FEEDBACK_SLACK_NS = 100_000_000  # a report waits for its turn on the other side
_SLACK_DATAGRAMS = 4  # and behind these datagrams of the link's own size
_DATAGRAM_AIRTIME_NS = 50_000_000  # no datagram holds the link for longer
_CREDIT_NS = 10_000_000  # what a late timer may catch up, as time at the present rate
_MIN_DATAGRAM_BYTES = 300  # wire; below this, headers eat more than 10 % of the link
_NS_PER_S = 1_000_000_000


class LinkEstimator(Protocol):
    """Judges one sending direction by what its own packets met.

    It is told of each datagram that leaves and of each report, and keeps its verdict in attributes,
    which the endpoint reads after every call. All rates count bytes on the wire, headers included.
    """

    @property
    def pacer(self) -> Pacing:
        """Says when a datagram may leave."""

    @property
    def trickles(self) -> bool:
        """Whether the pacer itself sees to it that little leaves while the link is dark."""

    @property
    def rate_bps(self) -> int:
        """What the link is taken to carry."""

    @property
    def datagram_bytes(self) -> int:
        """Size on the wire that a full datagram should have."""

    @property
    def in_flight_limit_bytes(self) -> int:
        """Beyond this only classes with always_send leave."""

    @property
    def band(self) -> str:
        """Name of what it takes the link for, for people."""

    @property
    def loss_ratio(self) -> float:
        """Of the packets reported on lately."""

    @property
    def queue_ns(self) -> int:
        """What the link is taken to need for what it holds."""

    @property
    def confidence(self) -> float:
        """0: blind, 1: measured and steady."""

    def on_sent(self, packet: SentPacket, now_ns: int) -> None:
        """A datagram has left."""

    def on_report(
        self, settled: Sequence[ReportedPacket], rtt_ns: int | None, loss_ratio: float, now_ns: int
    ) -> None:
        """The peer has reported on these packets (oldest first); rtt_ns excludes its holding time."""

    def on_heard(self, packet: HeardPacket, now_ns: int) -> None:
        """A datagram of the peer has come."""

    def probe_bytes(self, now_ns: int) -> int:
        """The size on the wire of a datagram that is to leave now to be timed; 0: none is."""

    def on_peer_restarted(self, now_ns: int) -> None:
        """The peer forgot what it knew of us."""

    def wakeup_at_ns(self) -> int | None:
        """When the estimator wants `on_timer`, if nothing happens before."""

    def on_timer(self, now_ns: int) -> None:
        """Time has passed."""


@dataclass(frozen=True, slots=True)
class PresetBand:
    """A band that the operator of the link has announced. rate_bps: capacity on the wire."""

    name: str
    rate_bps: int
    one_way_delay_ns: int


EstimatorFactory = Callable[[Sequence[PresetBand], int], LinkEstimator]
"""Makes an estimator from the presets, which may be none, and the local time (ns)."""


class PresetBands:
    """The rule of the DRC Trials system: the preset whose delay is nearest to the measured one.

    Departures from it: the delay is half the round trip of our own packets, as the peer reports them,
    so no clocks need to agree and a full queue is seen; there is no lock-out and no timed fall-back;
    and what is in flight is limited to what the band can hold, so a link that turns thin unseen gets
    no more than that before the sender waits. Of bands with the same delay the slowest is taken.
    """

    def __init__(
        self,
        bands: Sequence[PresetBand],
        pace_ratio: float = 0.95,
        max_wire_bytes: int = 1228,
        now_ns: int = 0,
    ) -> None:
        assert bands, "at least one preset band is needed"
        self.trickles = False
        self.queue_ns, self.confidence = 0, 1.0  # presets are not measured
        self._max_wire_bytes = max_wire_bytes
        self._bands = sorted(bands, key=lambda b: b.rate_bps)
        self._pace_ratio = pace_ratio
        self._rtts: deque[tuple[int, int]] = deque()  # (when, rtt)
        self.loss_ratio = 0.0
        self.pacer = Pacer(1, 0, now_ns)
        self._enter(self._bands[0], now_ns)  # the thinnest until the link has shown better

    def on_sent(self, packet: SentPacket, now_ns: int) -> None:
        """Nothing: presets do not learn from what is sent."""

    def on_report(
        self, settled: Sequence[ReportedPacket], rtt_ns: int | None, loss_ratio: float, now_ns: int
    ) -> None:
        """Compare the smallest of the newest round trips with the presets."""
        self.loss_ratio = loss_ratio
        if rtt_ns is None or not settled:
            return
        self._rtts.append((now_ns, rtt_ns))
        while self._rtts[0][0] < now_ns - _RTT_MEMORY_NS:
            self._rtts.popleft()
        delay_ns = min(rtt for _, rtt in self._rtts) // 2
        self._enter(min(self._bands, key=lambda b: abs(b.one_way_delay_ns - delay_ns)), now_ns)

    def on_heard(self, packet: HeardPacket, now_ns: int) -> None:
        """Nothing: presets are told apart by round trips."""

    def probe_bytes(self, now_ns: int) -> int:
        """None: messages tell the round trip."""
        return 0

    def on_peer_restarted(self, now_ns: int) -> None:
        """The link is the same; only the round trips to the former peer are forgotten."""
        self._rtts.clear()

    def wakeup_at_ns(self) -> int | None:
        return None

    def on_timer(self, now_ns: int) -> None:
        """Nothing happens with time alone."""

    def _enter(self, band: PresetBand, now_ns: int) -> None:
        self.band = band.name
        self.rate_bps = max(1, int(band.rate_bps * self._pace_ratio))
        if self.rate_bps != self.pacer.rate_bps:
            self.pacer.set_rate(self.rate_bps, self.rate_bps * _CREDIT_NS // (8 * _NS_PER_S), now_ns)
        self.datagram_bytes = datagram_wire_bytes(self.rate_bps, self._max_wire_bytes)
        hold_ns = 2 * band.one_way_delay_ns + _FEEDBACK_SLACK_NS
        slack_bytes = _SLACK_DATAGRAMS * self.datagram_bytes
        self.in_flight_limit_bytes = self.rate_bps * hold_ns // (8 * _NS_PER_S) + slack_bytes


def datagram_wire_bytes(rate_bps: int, max_wire_bytes: int) -> int:
    """Size of a full datagram at a rate: at most 50 ms of the link, never so small that headers rule."""
    airtime_bytes = rate_bps * _DATAGRAM_AIRTIME_NS // (8 * _NS_PER_S)
    return min(max_wire_bytes, max(_MIN_DATAGRAM_BYTES, airtime_bytes))

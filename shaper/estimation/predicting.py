"""The adaptive estimator, slowed just before a fall that is expected: optional, and off by default.

News of a fall takes a way back; what is sent meanwhile at the old rate queues at the new one, and no
measurement can prevent that. Where falls come at regular times they can be foreseen: from a little before
the link should fall until its news should have come, no more leaves than the link will carry afterwards.
That costs the rate for so long, once per fall; where the fall does not come it is not expected again soon.
"""

from __future__ import annotations

from collections.abc import Sequence

from shaper.estimation.adaptive import AdaptiveEstimator
from shaper.estimation.regular_falls import Expected, RegularFalls
from shaper.estimation.states import State
from shaper.link_estimator import datagram_wire_bytes
from shaper.pacer import Pacer, Pacing
from shaper.path import HeardPacket, ReportedPacket, SentPacket

CHANGED_RATIO = 0.7  # of one rate to the other: another band, not drift
MARGIN_NS = 60_000_000  # before the link should fall, and after its news should come
SLOW_SHARE = 0.9  # of the rate that is expected
_NEVER_NS = 1 << 62


class SlowedPacer:
    """Another pacer's word, and from from_ns until until_ns a token bucket's too. Implements Pacing."""

    def __init__(self, inner: Pacing) -> None:
        self._inner = inner
        self._bucket = Pacer(1, 0)
        self.from_ns = self.until_ns = _NEVER_NS

    def slow(self, rate_bps: int, from_ns: int, until_ns: int) -> None:
        """Let no more than this leave meanwhile."""
        self.from_ns, self.until_ns = from_ns, until_ns
        self._bucket = Pacer(rate_bps, 0, from_ns)

    def release(self) -> None:
        """Slow nothing."""
        self.from_ns = self.until_ns = _NEVER_NS

    def slows(self, now_ns: int) -> bool:
        """Whether less may leave than the other pacer would let."""
        return self.from_ns <= now_ns < self.until_ns

    def may_send(self, now_ns: int) -> bool:
        """Whether a datagram may leave now."""
        if not self._inner.may_send(now_ns):
            return False
        return not self.slows(now_ns) or self._bucket.may_send(now_ns)

    def next_send_at_ns(self, now_ns: int) -> int:
        """The earliest time at which `may_send` holds, if nothing is sent before."""
        at_ns = self._inner.next_send_at_ns(now_ns)
        if not self.slows(at_ns):
            return at_ns
        return max(at_ns, min(self._bucket.next_send_at_ns(at_ns), self.until_ns))

    def urgent_at_ns(self, now_ns: int) -> int:
        """The same for classes with always_send: they are not slowed."""
        return self._inner.urgent_at_ns(now_ns)

    def on_sent(self, wire_bytes: int, now_ns: int) -> None:
        """A datagram leaves, headers included, whether or not it was allowed to."""
        self._inner.on_sent(wire_bytes, now_ns)
        if self.slows(now_ns):
            self._bucket.on_sent(wire_bytes, now_ns)


class PredictingEstimator:
    """Implements shaper.link_estimator.LinkEstimator: what `inner` says, slower where a fall is expected."""

    def __init__(self, inner: AdaptiveEstimator, max_wire_bytes: int = 1228) -> None:
        self.inner = inner
        self.pacer = SlowedPacer(inner.pacer)
        self._falls = RegularFalls()
        self._expected: Expected | None = None
        self._max_wire_bytes = max_wire_bytes
        self._state = inner.state
        self._rate_bps = inner.rate_bps  # when it was known last
        self._news_ns = 0  # when run was left
        self._shortest_rtt_ns = _NEVER_NS  # in the present band
        self._now_ns = 0

    # What the endpoint reads.

    @property
    def trickles(self) -> bool:
        return self.inner.trickles

    @property
    def rate_bps(self) -> int:
        return self.inner.rate_bps

    @property
    def datagram_bytes(self) -> int:
        size_bytes = self.inner.datagram_bytes
        if self._expected is None or not self.pacer.slows(self._now_ns):
            return size_bytes
        return min(size_bytes, datagram_wire_bytes(int(self._expected.to_bps), self._max_wire_bytes))

    @property
    def in_flight_limit_bytes(self) -> int:
        return self.inner.in_flight_limit_bytes

    @property
    def band(self) -> str:
        return self.inner.band

    @property
    def loss_ratio(self) -> float:
        return self.inner.loss_ratio

    @property
    def queue_ns(self) -> int:
        return self.inner.queue_ns

    @property
    def confidence(self) -> float:
        return self.inner.confidence

    def probe_bytes(self, now_ns: int) -> int:
        self._now_ns = now_ns
        return self.inner.probe_bytes(now_ns)

    # What happens.

    def on_sent(self, packet: SentPacket, now_ns: int) -> None:
        self.inner.on_sent(packet, now_ns)
        self._look(now_ns)

    def on_report(
        self, settled: Sequence[ReportedPacket], rtt_ns: int | None, loss_ratio: float, now_ns: int
    ) -> None:
        self.inner.on_report(settled, rtt_ns, loss_ratio, now_ns)
        if rtt_ns is not None and rtt_ns < self._shortest_rtt_ns:
            self._shortest_rtt_ns = rtt_ns
            self._expect(now_ns)
        self._look(now_ns)

    def on_heard(self, packet: HeardPacket, now_ns: int) -> None:
        self.inner.on_heard(packet, now_ns)
        self._look(now_ns)

    def on_peer_restarted(self, now_ns: int) -> None:
        self.inner.on_peer_restarted(now_ns)

    def wakeup_at_ns(self) -> int | None:
        return self.inner.wakeup_at_ns()

    def on_timer(self, now_ns: int) -> None:
        self.inner.on_timer(now_ns)
        self._look(now_ns)

    # Falls, and what follows from them.

    def _look(self, now_ns: int) -> None:
        """See what the estimator has made of the news."""
        self._now_ns = now_ns
        before, self._state = self._state, self.inner.state
        if self._state is not State.RUN:
            if before is State.RUN:
                self._news_ns = now_ns
                self.pacer.release()  # from now on the estimator itself sees to what leaves
            return
        rate_bps, known_bps = self.inner.rate_bps, self._rate_bps
        self._rate_bps = rate_bps
        if rate_bps < CHANGED_RATIO * known_bps:
            self._falls.on_fall(now_ns if before is State.RUN else self._news_ns, known_bps, rate_bps)
            self._shortest_rtt_ns = _NEVER_NS
            self._expect(now_ns)
        elif known_bps < CHANGED_RATIO * rate_bps:
            self._shortest_rtt_ns = _NEVER_NS
            self._expect(now_ns)
        elif self._expected is not None and now_ns > self._expected.news_ns + self._margin_ns(self._expected):
            self._falls.on_missed(self._expected)
            self._expect(now_ns)
        elif before is not State.RUN:  # the band is as before, and so is what is expected of it
            self._expect(now_ns)

    def _expect(self, now_ns: int) -> None:
        """Foresee the next fall from the rate that the link has now."""
        expected = self._falls.expected(self._rate_bps)
        self._expected = expected
        self.pacer.release()
        if expected is not None and self._shortest_rtt_ns < _NEVER_NS:
            margin_ns = self._margin_ns(expected)
            from_ns = expected.news_ns - self._shortest_rtt_ns - margin_ns
            rate_bps = max(1, int(SLOW_SHARE * expected.to_bps))
            self.pacer.slow(rate_bps, max(from_ns, now_ns), expected.news_ns + margin_ns)

    @staticmethod
    def _margin_ns(expected: Expected) -> int:
        return MARGIN_NS + expected.spread_ns

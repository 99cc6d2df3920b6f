"""What the estimator is measured against: the rule of the Trials system, and a textbook delay gradient.

Neither is for use. Both are told what our own estimator is told, and paced by the same pacer.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from shaper.link_estimator import PresetBand, datagram_wire_bytes
from shaper.pacer import Pacer
from shaper.path import HeardPacket, ReportedPacket, SentPacket

_NS_PER_S = 1_000_000_000
_NS_PER_MS = 1_000_000
_CREDIT_NS = 10 * _NS_PER_MS
_NO_LIMIT_BYTES = 1 << 40


class Control:
    """What both have in common: a rate, and a pacer that keeps to it."""

    def __init__(self, rate_bps: int, now_ns: int) -> None:
        self.pacer = Pacer(1, 0, now_ns)
        self.trickles = False
        self.queue_ns, self.confidence = 0, 1.0
        self.band = ""
        self.loss_ratio = 0.0
        self.in_flight_limit_bytes = _NO_LIMIT_BYTES
        self._set_rate(rate_bps, now_ns)

    def _set_rate(self, rate_bps: int, now_ns: int) -> None:
        self.rate_bps = rate_bps
        self.datagram_bytes = datagram_wire_bytes(rate_bps, 1228)
        self.pacer.set_rate(rate_bps, rate_bps * _CREDIT_NS // (8 * _NS_PER_S), now_ns)

    def on_sent(self, packet: SentPacket, now_ns: int) -> None:
        """Nothing to learn."""

    def on_report(
        self, settled: Sequence[ReportedPacket], rtt_ns: int | None, loss_ratio: float, now_ns: int
    ) -> None:
        """Nothing to learn but the loss."""
        self.loss_ratio = loss_ratio

    def on_heard(self, packet: HeardPacket, now_ns: int) -> None:
        """Nothing to learn."""

    def probe_bytes(self, now_ns: int) -> int:
        return 0

    def on_peer_restarted(self, now_ns: int) -> None:
        """Nothing to forget."""

    def wakeup_at_ns(self) -> int | None:
        return None

    def on_timer(self, now_ns: int) -> None:
        """Nothing happens with time alone."""


class TrialsRule(Control):
    """Team MIT's shaper at the Trials, December 2013, with the settings of its configuration file.

    Once a second the latency of the last packet *received* (so of the other direction, and only with
    synchronised clocks) picks the nearest preset; no change within 15 s of the last; after 50 s at the high
    rate it falls back to the low one. Source: their shaper-handlers.cpp, drc_robot_02_trials.cfg.
    """

    LATENCY_MS_TO_BPS = ((50, 950_000), (500, 95_000))
    FALLBACK_BPS = 95_000
    LOCK_OUT_NS = 15 * _NS_PER_S
    FALLBACK_NS = 50 * _NS_PER_S

    def __init__(self, bands: Sequence[PresetBand], now_ns: int) -> None:
        super().__init__(self.FALLBACK_BPS, now_ns)
        self._latency_ms: float | None = None
        self._changed_ns = now_ns - self.LOCK_OUT_NS
        self._wakeup_ns = now_ns + _NS_PER_S

    def on_heard(self, packet: HeardPacket, now_ns: int) -> None:
        stamped = now_ns // 1000 - packet.sent_us
        self._latency_ms = ((stamped + (1 << 31)) % (1 << 32) - (1 << 31)) / 1000

    def wakeup_at_ns(self) -> int | None:
        return self._wakeup_ns

    def on_timer(self, now_ns: int) -> None:
        self._wakeup_ns = now_ns + _NS_PER_S
        if self._latency_ms is None:
            return
        latency_ms = self._latency_ms
        _, rate_bps = min(self.LATENCY_MS_TO_BPS, key=lambda band: abs(band[0] - latency_ms))
        for_ns = now_ns - self._changed_ns
        if self.rate_bps != self.FALLBACK_BPS and for_ns > self.FALLBACK_NS:
            rate_bps = self.FALLBACK_BPS
        elif rate_bps == self.rate_bps or for_ns <= self.LOCK_OUT_NS:
            return
        self._changed_ns = now_ns
        self._set_rate(rate_bps, now_ns)


class DelayGradient(Control):
    """The delay-based half of Google's congestion control, after draft-ietf-rmcat-gcc-02.

    Growth of the one-way delay (a trend line over 20 reports) above an adaptive threshold cuts the rate to
    0.85 of what was delivered; otherwise it grows by 8 % a second, up to 1.5 times what was delivered.
    """

    START_BPS, LEAST_BPS, MOST_BPS = 300_000, 10_000, 20_000_000
    GAIN, SAMPLES = 60, 20
    THRESHOLD_MS, UP, DOWN = 12.5, 0.0087, 0.039

    def __init__(self, bands: Sequence[PresetBand], now_ns: int) -> None:
        super().__init__(self.START_BPS, now_ns)
        self._delays: deque[tuple[float, float]] = deque(maxlen=self.SAMPLES)  # (arrival ms, delay ms)
        self._delivered: deque[tuple[int, int]] = deque()  # (when, bytes)
        self._threshold_ms = self.THRESHOLD_MS
        self._updated_ns = now_ns

    def on_report(
        self, settled: Sequence[ReportedPacket], rtt_ns: int | None, loss_ratio: float, now_ns: int
    ) -> None:
        self.loss_ratio = loss_ratio
        for packet in settled:
            if packet.arrival_us is not None:
                arrival_ms = packet.arrival_us / 1000
                self._delays.append((arrival_ms, arrival_ms - packet.sent_ns / 1e6))
                self._delivered.append((now_ns, packet.wire_bytes))
        while self._delivered and self._delivered[0][0] < now_ns - _NS_PER_S // 2:
            self._delivered.popleft()
        if len(self._delays) < self.SAMPLES or now_ns - self._updated_ns < 50 * _NS_PER_MS:
            return
        elapsed_s = min(1.0, (now_ns - self._updated_ns) / _NS_PER_S)
        self._updated_ns = now_ns
        trend_ms = self._slope() * self.GAIN
        gain = self.UP if abs(trend_ms) > self._threshold_ms else self.DOWN
        self._threshold_ms += gain * (abs(trend_ms) - self._threshold_ms) * min(100.0, elapsed_s * 1000)
        self._threshold_ms = min(600.0, max(6.0, self._threshold_ms))
        delivered_bps = 16 * sum(size for _, size in self._delivered)
        rate = float(self.rate_bps)
        if trend_ms > self._threshold_ms:
            rate = min(rate, 0.85 * delivered_bps)
        elif trend_ms > -self._threshold_ms:
            rate = min(rate * 1.08**elapsed_s, max(rate, 1.5 * delivered_bps))
        self._set_rate(int(min(self.MOST_BPS, max(self.LEAST_BPS, rate))), now_ns)

    def _slope(self) -> float:
        n = len(self._delays)
        mean_t = sum(t for t, _ in self._delays) / n
        mean_d = sum(d for _, d in self._delays) / n
        spread = sum((t - mean_t) ** 2 for t, _ in self._delays)
        return sum((t - mean_t) * (d - mean_d) for t, d in self._delays) / spread if spread else 0.0

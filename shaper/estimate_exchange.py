"""Each end tells the other what it takes its own direction for, once a second in about ten bytes."""

from __future__ import annotations

from shaper.events import LinkState, PeerEstimate
from shaper.frames import EstimateFrame
from shaper.link_estimator import LinkEstimator
from shaper.path import Path
from shaper.varint import MAX_VALUE

STALE_NS = 5_000_000_000  # what was told longer ago is not shown as if it were so
_NAMED_BEATS = 3  # a band's name goes out so often when it is new, as datagrams get lost, ...
_NAME_EVERY = 8  # ... and with every so many later beats
_LEAST_CONFIDENCE = 0.5
_NS_PER_MS = 1_000_000


class EstimateExchange:
    """What the peer has told of its direction, and how much of ours it has to be told."""

    def __init__(self) -> None:
        self.theirs: PeerEstimate | None = None  # the direction that we receive by, if told of lately
        self.told_bps = 0  # the rate that it told last, however long ago
        self._band = ""  # the peer's, by the last name that came
        self._told_band = ""  # ours, as told
        self._told = 0  # so many beats ago, and longer

    def on_peer_restarted(self) -> None:
        """Another life of the peer has told nothing, and knows nothing of ours."""
        self.theirs, self.told_bps, self._band = None, 0, ""
        self._told_band, self._told = "", 0

    def take(self, state: LinkState, now_ns: int) -> EstimateFrame | None:
        """What to tell now of our direction; that nothing is known, once: a dark link may keep it all."""
        if self.theirs is not None and now_ns - self.theirs.told_ns > STALE_NS:
            self.theirs = None
        if state.band != self._told_band:
            self._told_band, self._told = state.band, 0
        named = self._told < _NAMED_BEATS or self._told % _NAME_EVERY == 0
        self._told += 1
        if self._told > 1 and (state.holding or state.confidence < _LEAST_CONFIDENCE):
            return None
        return EstimateFrame(
            min(state.rate_bps, MAX_VALUE),
            min(max(0, state.queue_ns) // _NS_PER_MS, MAX_VALUE),
            min(1.0, max(0.0, state.loss_ratio)),
            min(1.0, max(0.0, state.confidence)),
            state.holding,
            state.band if named else None,
        )

    def on_frame(self, frame: EstimateFrame, now_ns: int) -> None:
        """The peer tells what it takes its direction for."""
        if frame.band is not None:
            self._band = frame.band
        self.told_bps = frame.rate_bps
        self.theirs = PeerEstimate(
            frame.rate_bps,
            self._band,
            round(frame.loss_ratio, 4),
            frame.holding,
            frame.queue_ms * _NS_PER_MS,
            round(frame.confidence, 2),
            now_ns,
        )


def link_state(
    estimator: LinkEstimator, path: Path, theirs: PeerEstimate | None, *, holding: bool
) -> LinkState:
    """What a side believes of its sending direction, and was told of the other one."""
    return LinkState(
        rate_bps=estimator.rate_bps,
        band=estimator.band,
        rtt_ns=path.rtt_ns,
        in_flight_bytes=path.bytes_in_flight,
        in_flight_limit_bytes=estimator.in_flight_limit_bytes,
        loss_ratio=path.loss_ratio,
        holding=holding,
        queue_ns=estimator.queue_ns,
        confidence=estimator.confidence,
        receiving=theirs,
    )

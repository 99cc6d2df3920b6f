"""Bands that the link has shown: recognised where a rise leads to one of them, and named for people.

How slow a link may have become is not guessed by them: a train tells that in the same round trip, and
where bands change at random some come near each other by chance.
"""

from __future__ import annotations

from dataclasses import dataclass

_SAME_RATIO = 1.25  # rates within this are one band ...
_SAME_RTT = (30_000_000, 0.25)  # ... if their round trips differ by less than this, or this share
_QUEUED_NS = 80_000_000  # of a round trip may be queue
_LIKELY_RATIO = 2.0  # trains tell at least half the rate
_FOLLOW = 0.1  # how quickly a band's figures follow the newest
_MOST = 16


@dataclass(slots=True)
class Band:
    """rtt_ns: without queue."""

    rate_bps: float
    rtt_ns: int

    @property
    def name(self) -> str:
        """For people."""
        rate = f"{self.rate_bps / 1e6:.2g} Mbit/s" if self.rate_bps >= 999_500 else ""
        return f"{rate or f'{self.rate_bps / 1e3:.3g} kbit/s'} {self.rtt_ns / 2e6:.0f} ms"


class Bands:
    """The bands seen so far; `current` is the one that the link is in, if it is known."""

    def __init__(self) -> None:
        self._known: list[Band] = []
        self.current: Band | None = None

    def settle(self, rate_bps: float, rtt_ns: int) -> None:
        """The link has been like this for a while."""
        band = self.current
        if band is None or not _same(band, rate_bps, rtt_ns):
            band = next((b for b in self._known if _same(b, rate_bps, rtt_ns)), None)
            if band is None:
                band = Band(rate_bps, rtt_ns)
                self._known = [*self._known[-_MOST + 1 :], band]
            self.current = band
        band.rate_bps += _FOLLOW * (rate_bps - band.rate_bps)
        band.rtt_ns += int(_FOLLOW * (rtt_ns - band.rtt_ns))

    def leave(self) -> None:
        """The link has changed."""
        self.current = None

    def likely(self, least_bps: float, rtt_ns: int) -> float:
        """The slowest band of about this round trip (ns) that is somewhat faster; or least_bps.

        What trains tell first is too little where arrivals are noisy.
        """
        rates = [
            b.rate_bps
            for b in self._known
            if least_bps <= b.rate_bps < _LIKELY_RATIO * least_bps
            and -_SAME_RTT[0] < rtt_ns - b.rtt_ns < _QUEUED_NS
        ]
        return min(rates, default=least_bps)


def _same(band: Band, rate_bps: float, rtt_ns: int) -> bool:
    ratio = band.rate_bps / rate_bps
    near_ns = max(_SAME_RTT[0], int(_SAME_RTT[1] * band.rtt_ns))
    return 1 / _SAME_RATIO < ratio < _SAME_RATIO and abs(band.rtt_ns - rtt_ns) < near_ns

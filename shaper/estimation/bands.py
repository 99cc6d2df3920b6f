"""Bands that the link has shown: remembered as a guess of how slow it may have become, and to be named."""

from __future__ import annotations

from dataclasses import dataclass

_SAME_RATIO = 1.25  # rates within this are one band ...
_SAME_RTT = (30_000_000, 0.25)  # ... if their round trips differ by less than this, or this share
_QUEUED_NS = 80_000_000  # of a round trip may be queue
_LIKELY_RATIO = 2.0  # trains tell at least half the rate
_FOLLOW = 0.1  # how quickly a band's figures follow the newest
_TRUSTED_VISITS = 3  # links that change at random come near a band twice by chance
_MOST = 16
CAUTION = 10  # a band that is not known may be so many times slower than the last
LEAST_CAUTIOUS_BPS = 8_000  # but hardly slower than the slowest link that we are made for


@dataclass(slots=True)
class Band:
    """rtt_ns: without queue. visits: how often it was entered."""

    rate_bps: float
    rtt_ns: int
    visits: int = 1

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
                band = Band(rate_bps, rtt_ns, 0)
                self._known = [*self._known[-_MOST + 1 :], band]
            band.visits += 1
            self.current = band
        band.rate_bps += _FOLLOW * (rate_bps - band.rate_bps)
        band.rtt_ns += int(_FOLLOW * (rtt_ns - band.rtt_ns))

    def leave(self) -> None:
        """The link has changed."""
        self.current = None

    def likely(self, least_bps: float, rtt_ns: int) -> float:
        """The slowest band of about this round trip (ns) that is somewhat faster; or least_bps."""
        rates = [
            b.rate_bps
            for b in self._known
            if least_bps <= b.rate_bps < _LIKELY_RATIO * least_bps
            and -_SAME_RTT[0] < rtt_ns - b.rtt_ns < _QUEUED_NS
        ]
        return min(rates, default=least_bps)

    def cautious_bps(self, known_bps: float, *, seen: bool = True) -> float:
        """How slow a link of this rate may have become: a band that was seen, if `seen`, or a tenth."""
        tenth_bps = max(known_bps / CAUTION, min(known_bps, LEAST_CAUTIOUS_BPS))
        lowest = self.lowest_below(known_bps) if seen else None
        return tenth_bps if lowest is None else max(tenth_bps, lowest.rate_bps)

    def lowest_below(self, rate_bps: float) -> Band | None:
        """The slowest band that is clearly slower than this, and that the link comes back to."""
        slower = [
            band for band in self._known if band.rate_bps < 0.7 * rate_bps and band.visits >= _TRUSTED_VISITS
        ]
        return min(slower, key=lambda band: band.rate_bps, default=None)


def _same(band: Band, rate_bps: float, rtt_ns: int) -> bool:
    ratio = band.rate_bps / rate_bps
    near_ns = max(_SAME_RTT[0], int(_SAME_RTT[1] * band.rtt_ns))
    return 1 / _SAME_RATIO < ratio < _SAME_RATIO and abs(band.rtt_ns - rtt_ns) < near_ns

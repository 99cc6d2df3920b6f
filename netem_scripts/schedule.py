"""The rate of a link as an exact function of time, and its inverse.

Capacity is counted in nanobits: bit/s times ns. All figures are integers, so a service that ends in the
middle of a band, or some bands later, ends at one exact instant whatever way it is computed.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import dataclass

from .band import Band, DirectionProfile

NANOBITS_PER_BIT = 1_000_000_000
NANOBITS_PER_BYTE = 8 * NANOBITS_PER_BIT
FOREVER_NS = 1 << 62  # 146 years: the end of the last band of a schedule that is not cyclic


@dataclass(frozen=True, slots=True)
class Segment:
    """One occurrence of a band, with the capacity that the link had offered at its start and its end.

    drain_rate_bps: the band's rate; in a blackout that holds, the rate before it (after it, if none).
    ideal: no loss, jitter, duplicates or reordering.
    """

    start_ns: int
    end_ns: int
    start_nanobits: int
    end_nanobits: int
    rate_bps: int
    one_way_delay_ns: int
    drain_rate_bps: int
    ideal: bool
    band: Band


class Schedule:
    """The bands of one direction from t = 0 on; stateless, so any instant may be asked for."""

    def __init__(self, direction: DirectionProfile) -> None:
        self._bands = direction.bands
        self._cyclic = direction.cyclic
        self._starts_ns = [0]
        self._starts_nanobits = [0]
        for band in direction.bands:
            self._starts_ns.append(self._starts_ns[-1] + band.duration_ns)
            self._starts_nanobits.append(self._starts_nanobits[-1] + band.duration_ns * band.rate_bps)
        self._cycle_ns = self._starts_ns.pop()
        self._cycle_nanobits = self._starts_nanobits.pop()
        self._drain_rates_bps = _drain_rates_bps(direction.bands, direction.cyclic)

    def segment_at(self, now_ns: int) -> Segment:
        """The band in force at now_ns (its start included, its end not)."""
        cycle, into_ns = divmod(now_ns, self._cycle_ns) if self._cyclic else (0, now_ns)
        return self._segment(cycle, bisect_right(self._starts_ns, into_ns) - 1)

    def segment_serving(self, nanobits: int) -> Segment:
        """The band in which capacity beyond `nanobits` is first offered; its rate is never 0."""
        cycle, into = divmod(nanobits, self._cycle_nanobits) if self._cyclic else (0, nanobits)
        return self._segment(cycle, bisect_right(self._starts_nanobits, into) - 1)

    def nanobits_at(self, now_ns: int) -> int:
        """The capacity offered from t = 0 to now_ns."""
        segment = self.segment_at(now_ns)
        return segment.start_nanobits + (now_ns - segment.start_ns) * segment.rate_bps

    def _segment(self, cycle: int, index: int) -> Segment:
        band = self._bands[index]
        start_ns = cycle * self._cycle_ns + self._starts_ns[index]
        start_nanobits = cycle * self._cycle_nanobits + self._starts_nanobits[index]
        last = not self._cyclic and index == len(self._bands) - 1
        end_ns = FOREVER_NS if last else start_ns + band.duration_ns
        return Segment(
            start_ns=start_ns,
            end_ns=end_ns,
            start_nanobits=start_nanobits,
            end_nanobits=start_nanobits + (end_ns - start_ns) * band.rate_bps,
            rate_bps=band.rate_bps,
            one_way_delay_ns=band.one_way_delay_ns,
            drain_rate_bps=self._drain_rates_bps[index],
            ideal=band.is_ideal,
            band=band,
        )


def _drain_rates_bps(bands: tuple[Band, ...], cyclic: bool) -> list[int]:
    """Each band's rate, 0 replaced by the last rate before it that was not 0, or the first after it."""
    positive = [band.rate_bps for band in bands if band.rate_bps]
    previous_bps = positive[-1] if cyclic else positive[0]
    rates_bps = []
    for band in bands:
        previous_bps = band.rate_bps or previous_bps
        rates_bps.append(previous_bps)
    return rates_bps

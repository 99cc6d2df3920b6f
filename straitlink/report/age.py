"""Age of information: how old the newest sample at the receiver is, at every moment.

Source: Kaul, Yates, Gruteser, "Real-time status: how often should one update?", INFOCOM 2012.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .run import Deliveries, Times, known


@dataclass(frozen=True, slots=True)
class Sawtooth:
    """The age from the first delivery to the end of the run: ramps of slope 1, (N,) each.

    Ramp i begins at begin_ns[i] at age low_ns[i] and lasts width_ns[i].
    """

    begin_ns: Times
    low_ns: Times
    width_ns: Times

    def at(self, t_ns: Times) -> NDArray[np.float64]:
        """The age at each time, NaN before the first delivery."""
        ramp = np.searchsorted(self.begin_ns, t_ns, side="right") - 1
        age_ns = self.low_ns[ramp] + (t_ns - self.begin_ns[ramp])
        return np.where(ramp >= 0, age_ns, np.nan)

    def peak_between(self, edges_ns: Times) -> NDArray[np.float64]:
        """The greatest age within each [edge, next edge), (len(edges) - 1,); NaN before the first delivery.

        Peaks are just before a delivery or just before the bin's end.
        """
        peaks = self.at(edges_ns[1:] - 1)
        bins = np.searchsorted(edges_ns, self.begin_ns[1:], side="right") - 1
        inside = (bins >= 0) & (bins < peaks.size)
        np.fmax.at(peaks, bins[inside], (self.low_ns + self.width_ns)[:-1][inside])
        return peaks

    def quantiles_ns(self, shares: tuple[float, ...]) -> tuple[int, ...]:
        """Ages below which the receiver's knowledge is for these shares of the time, exactly.

        The time spent below age x grows at the rate of how many ramps pass through x: piecewise
        linear, so each quantile is one interpolation.
        """
        ages = np.concatenate([self.low_ns, self.low_ns + self.width_ns])
        turns = np.concatenate([np.ones_like(self.low_ns), -np.ones_like(self.low_ns)])
        order = np.argsort(ages, kind="stable")
        ages, ramps = ages[order], np.cumsum(turns[order])
        spent_ns = np.concatenate([[0], np.cumsum(ramps[:-1] * np.diff(ages))])
        wanted = np.array(shares) * spent_ns[-1]
        after = np.clip(np.searchsorted(spent_ns, wanted, side="left"), 1, ages.size - 1)
        found = ages[after] - (spent_ns[after] - wanted) / np.maximum(ramps[after - 1], 1)
        return tuple(round(float(age)) for age in found)


def sawtooth(deliveries: Deliveries, end_ns: int) -> Sawtooth | None:
    """The age's course; a sample older than what the receiver already has changes nothing.

    None where nothing was delivered before end_ns.
    """
    inside = (deliveries.t_ns < end_ns) & known(deliveries.age_ns)
    begin_ns = deliveries.t_ns[inside]
    if not begin_ns.size:
        return None
    newest_ns = np.maximum.accumulate(begin_ns - deliveries.age_ns[inside])
    return Sawtooth(begin_ns, begin_ns - newest_ns, np.diff(np.append(begin_ns, end_ns)))

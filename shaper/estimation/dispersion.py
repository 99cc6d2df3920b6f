"""Capacity from the spacing of arrivals.

A link of rate C that keeps the order spreads two datagrams by at least the second one's bits over C, and
by just that if the second had to wait for the first. So bits over spread is never more than the rate, and
is the rate wherever the second datagram left before the first was served. Sums over neighbours telescope:
noise of the arrivals counts once per run, not once per pair.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from itertools import islice

from shaper.estimation.flights import Flight

_PAIRS = 400
_NOISE_PAIRS = 24  # noise must have been there for one to two times so many pairs to be believed
FASTEST_BPS = 200e6  # a smaller spread is a clump behind a delay that fell, no measurement
_FALL_RATIO = 1.28  # spread over what the rate explains, beyond which the rate has fallen
RISE_RATIO = 1.25  # and the same for a rise
_MORE_RATIO = 1.04  # beyond which trains tell that the rate is known too low
_NOISE_FACTOR = 5.0  # noise (one sigma) that evidence must exceed
_FALL_FLOOR_NS = 1_500_000
_RISE_DOUBT = 3.0  # noises by which a train may have come too close
_RISE_FLOOR_NS = 20_000  # a clock's grain
_TRAIN_GAP = 0.5  # of what a datagram takes at the known rate: so close together leave trains
_TESTED_PAIRS = 60  # as far back as a fall or a rise may show
_EXPANDED = 0.8  # gap over spread, below which the second datagram has surely waited
_APART = 2.0  # of what a datagram takes: what leaves so far apart need not queue
_TRAIN_EXPANDED = 0.6
_CLUMPING_NS, _CLUMPED_PAIRS = 2_000_000, 6  # noise that makes whole trains arrive at once
_CLUMP_FLOOR_NS = 5_000_000  # what left over a longer time and arrived together came behind a falling delay
_STILL_RATIO = 0.8
_WINDOW_NOISES = 200  # the average runs over so many sigma of arrivals: within 1 % of the rate ...
_WINDOW_NS = (250_000_000, 4_000_000_000)  # ... but within these bounds


class Pair:
    """Two datagrams in a row that arrived. gap_ns: between departures; spread_ns: between arrivals.

    bits: of the second; more_bits: than of the first. queued: the second is taken to have met a queue.
    measurable: how close they arrived says something about the rate.
    """

    __slots__ = ("bits", "gap_ns", "measurable", "more_bits", "number", "queued", "sent_ns", "spread_ns")

    def __init__(self, first: Flight, second: Flight) -> None:
        assert first.arrived_ns is not None and second.arrived_ns is not None, "pairs have arrived"
        self.number = second.number
        self.sent_ns = second.sent_ns
        self.gap_ns = second.sent_ns - first.sent_ns
        self.spread_ns = second.arrived_ns - first.arrived_ns
        self.bits = second.bits
        self.more_bits = second.bits - first.bits
        self.queued = second.wait_ns > 0
        self.measurable = self.spread_ns * FASTEST_BPS > self.bits * 1e9

    def widest_ns(self, rate_bps: float) -> float:
        """How far a link of this rate spreads them at most: what it needs for the second, or was idle."""
        needs_ns = self.bits * 1e9 / rate_bps
        return max(needs_ns, self.gap_ns + self.more_bits * 1e9 / rate_bps)

    def is_of(self, rate_bps: float) -> bool:
        """Whether a link of this rate would have spread them so."""
        return 1 / RISE_RATIO < self.spread_ns * rate_bps / (self.bits * 1e9) < _FALL_RATIO


class Dispersion:
    """The pairs of late, and how noisy their spreads are.

    What they tell is looked for when a pair has come that could change it, not at each report.
    """

    def __init__(self) -> None:
        self._pairs: deque[Pair] = deque(maxlen=_PAIRS)
        self._deviation_ns = 0.0
        self._former_ns = (0.0, 0.0)  # deviations before; a change of rate is no noise
        self._counted = 0
        self._clump_ns: int | None = None  # when the first of those left that have just arrived together
        self._follows = self._widens = self._closes = False  # whether a new pair has met a queue, and ...

    @property
    def noise_ns(self) -> float:
        """Sigma of a spread; that of one arrival is 0.7 of it."""
        return 1.25 * min(self._deviation_ns, self._former_ns[0])

    def add(self, first: Flight, second: Flight, rate_bps: float | None) -> None:
        """Two neighbours have arrived. rate_bps: what the noise is judged by; None: it is not."""
        pair = Pair(first, second)
        self._pairs.append(pair)
        self._follow_clump(pair)
        if rate_bps is None:
            return
        explained_ns = pair.bits * 1e9 / rate_bps
        if pair.gap_ns <= _TRAIN_GAP * explained_ns:  # ... could show a faster link
            self._closes = True
        if pair.queued:
            self._follows = True
            if pair.spread_ns > _FALL_RATIO * explained_ns:  # ... could show a slower one
                self._widens = True
            off_ns = abs(pair.spread_ns - explained_ns)
            off_ns = min(off_ns, abs(pair.spread_ns - pair.gap_ns))  # the link may be faster than known
            off_ns = min(off_ns, 3 * self._deviation_ns + 2_000_000)
            self._deviation_ns += (off_ns - self._deviation_ns) / 16
            self._counted += 1
            if self._counted % _NOISE_PAIRS == 0:
                self._former_ns = (self._former_ns[1], self._deviation_ns)

    def _follow_clump(self, pair: Pair) -> None:
        """Where the delay falls, what left meanwhile comes at once, and the next one as if close."""
        first_sent_ns = pair.sent_ns - pair.gap_ns
        if not pair.measurable:
            self._clump_ns = first_sent_ns if self._clump_ns is None else self._clump_ns
        elif self._clump_ns is not None:
            spanned_ns = first_sent_ns - self._clump_ns
            pair.measurable = spanned_ns < _CLUMP_FLOOR_NS + _NOISE_FACTOR * self.noise_ns
            self._clump_ns = None

    def forget_before(self, sent_ns: int) -> None:
        """Earlier pairs belong to another band."""
        while self._pairs and self._pairs[0].sent_ns < sent_ns:
            self._pairs.popleft()

    def forget(self) -> None:
        """All of them do."""
        self._pairs.clear()

    def fallen(self, rate_bps: float) -> float | None:
        """The rate (bit/s) to which the link has fallen, if arrivals are spread by more than explained.

        The slowest pair does not count: one late arrival is no fall.
        """
        if not self._widens:
            return None
        self._widens = False
        apart_ns = _APART * 1e9 / rate_bps
        floor_ns = _NOISE_FACTOR * self.noise_ns + _FALL_FLOOR_NS
        bits = spread_ns = gap_ns = count = 0
        explained_ns = 0.0
        slowest: Pair | None = None
        for pair in self._newest():
            if not pair.queued or pair.gap_ns > max(apart_ns * pair.bits, _EXPANDED * pair.spread_ns):
                continue  # those that left far apart arrive so on an empty link
            bits, spread_ns, gap_ns = bits + pair.bits, spread_ns + pair.spread_ns, gap_ns + pair.gap_ns
            explained_ns += pair.widest_ns(rate_bps)
            count += 1
            if slowest is None or pair.spread_ns > slowest.spread_ns:
                slowest = pair
            if count < 3:
                continue
            rest_ns = spread_ns - slowest.spread_ns
            rest_explained_ns = explained_ns - slowest.widest_ns(rate_bps)
            if (
                rest_ns > _FALL_RATIO * rest_explained_ns
                and rest_ns - rest_explained_ns > floor_ns
                and gap_ns - slowest.gap_ns < _EXPANDED * rest_ns
            ):
                return (bits - slowest.bits) * 1e9 / rest_ns
        return None

    def risen(self, rate_bps: float) -> float | None:
        """The rate (bit/s) that the link has at least, if trains arrive closer than the rate allows.

        Only pairs that left closer than that can tell. Noise counts once per train.
        """
        if not self._closes:
            return None
        self._closes = False
        noise_ns = self.noise_ns
        bits = spread_ns = trains = pairs = 0
        best_bps, number = 0.0, -1
        for pair in self._newest():
            explained_ns = pair.bits * 1e9 / rate_bps
            if pair.gap_ns > _TRAIN_GAP * explained_ns or not pair.measurable:
                continue
            trains += pair.number != number - 1
            number = pair.number
            bits, spread_ns, pairs = bits + pair.bits, spread_ns + pair.spread_ns, pairs + 1
            if pairs >= 2:
                doubt_ns = _RISE_DOUBT * noise_ns * trains**0.5 + _RISE_FLOOR_NS
                best_bps = max(best_bps, bits * 1e9 / (spread_ns + doubt_ns))
        return best_bps if best_bps > _MORE_RATIO * rate_bps else None

    def average(self, rate_bps: float) -> float | None:
        """The rate over the last pairs that met a queue; None while there are too few, or none is new."""
        if not self._follows:
            return None
        self._follows = False
        noise_ns = self.noise_ns
        window_ns = min(_WINDOW_NS[1], max(_WINDOW_NS[0], _WINDOW_NOISES * noise_ns))
        bits = spread_ns = 0
        for pair in reversed(self._pairs):
            if not pair.queued:
                continue
            expected_ns = pair.bits * 1e9 / rate_bps
            off_ns = abs(pair.spread_ns - expected_ns)
            if off_ns < _NOISE_FACTOR * noise_ns + 0.5 * expected_ns:
                bits, spread_ns = bits + pair.bits, spread_ns + pair.spread_ns
                if spread_ns >= window_ns:
                    return bits * 1e9 / spread_ns
        return None

    def still(self, since_ns: int, known_bps: float) -> bool:
        """Whether what left since then arrived as close as only about the known rate allows."""
        pairs = [p for p in self._pairs if p.sent_ns >= since_ns and p.measurable]
        if self.noise_ns > _CLUMPING_NS:  # then clumps are measurements too, over several trains
            trains = [
                p
                for p in self._pairs
                if p.sent_ns >= since_ns and p.gap_ns * known_bps < _TRAIN_GAP * p.bits * 1e9
            ]
            if len(trains) >= _CLUMPED_PAIRS and _ratio(trains) >= _STILL_RATIO * known_bps:
                return True
        if len(pairs) < 2:
            return False
        closest = sorted(pairs, key=lambda p: p.spread_ns / p.bits)[: max(2, len(pairs) // 2)]
        return _ratio(closest) >= _STILL_RATIO * known_bps

    def of_trains(self, since_ns: int, surely_ns: int, known_bps: float | None) -> float | None:
        """The rate by the trains that left since then.

        What left before `surely_ns` may have met the former link: where it looks like that, it says nothing.
        """
        pairs = [
            p
            for p in self._pairs
            if p.sent_ns >= since_ns
            and p.measurable
            and (p.sent_ns >= surely_ns or known_bps is None or not p.is_of(known_bps))
        ]
        trains = [p for p in pairs if p.gap_ns < _TRAIN_EXPANDED * p.spread_ns]
        if len(trains) < 2:
            return None
        trains.sort(key=lambda p: p.spread_ns / p.bits)
        if len(trains) >= 3:
            trains.pop()
        elif trains[1].spread_ns / trains[1].bits > 1.5 * trains[0].spread_ns / trains[0].bits:
            return None
        spread_ns = sum(p.spread_ns for p in trains)
        if spread_ns < 2 * self.noise_ns * len(trains) ** 0.5:
            return None
        return _ratio(trains)

    def _newest(self) -> Iterable[Pair]:
        return islice(reversed(self._pairs), _TESTED_PAIRS)


def _ratio(pairs: Iterable[Pair]) -> float:
    pairs = list(pairs)
    return sum(p.bits for p in pairs) * 1e9 / max(1, sum(p.spread_ns for p in pairs))

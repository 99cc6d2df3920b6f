"""Falls of the link's rate that come at regular times: learnt from those that came, expected again.

A fall is known by the rates before and after it. Three of a kind, evenly spaced, are a rule; the next one is
expected one interval after the last. One that does not come in time ends the rule, and twice as many falls as
before must come before there is another of this kind: so a link that only looked regular costs little, and
ever less.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from itertools import pairwise

NEEDED = 3  # falls, evenly spaced
LEAST_INTERVAL_NS = 5_000_000_000  # what comes more often is not worth slowing for
SPREAD_NS, SPREAD_SHARE = 150_000_000, 0.002  # intervals that differ by less, or by this share, are even
SAME_RATIO = 1.25  # rates within this are one
_MOST_KINDS, _MOST_NEEDED = 16, 1000


@dataclass(frozen=True, slots=True)
class Expected:
    """A fall that should come. news_ns: when its news should; spread_ns: how far off that may be."""

    news_ns: int
    spread_ns: int
    from_bps: float
    to_bps: float


@dataclass(slots=True)
class _Kind:
    """Falls between the same two rates. news_ns: when the last NEEDED were known, the newest last.

    since_rule: how many came since a rule of theirs was broken; needed: how many must.
    """

    from_bps: float
    to_bps: float
    news_ns: deque[int] = field(default_factory=lambda: deque(maxlen=NEEDED))
    since_rule: int = 0
    needed: int = NEEDED


class RegularFalls:
    """The falls seen so far, by kind."""

    def __init__(self) -> None:
        self._kinds: list[_Kind] = []

    def on_fall(self, news_ns: int, from_bps: float, to_bps: float) -> None:
        """The rate has fallen; this was known at that time."""
        same = (k for k in self._kinds if _is_same(k.from_bps, from_bps) and _is_same(k.to_bps, to_bps))
        kind = next(same, None)
        if kind is None:
            kind = _Kind(from_bps, to_bps)
            self._kinds = [*self._kinds[-_MOST_KINDS + 1 :], kind]
        kind.from_bps, kind.to_bps = from_bps, to_bps
        kind.news_ns.append(news_ns)
        kind.since_rule += 1

    def expected(self, rate_bps: float) -> Expected | None:
        """The next fall from this rate that a rule foretells; its time may have passed."""
        found = (self._next(kind) for kind in self._kinds if _is_same(kind.from_bps, rate_bps))
        return min((each for each in found if each is not None), key=lambda each: each.news_ns, default=None)

    def on_missed(self, expected: Expected) -> None:
        """It did not come, or was not noticed in time."""
        for kind in self._kinds:
            if (kind.from_bps, kind.to_bps) == (expected.from_bps, expected.to_bps):
                kind.since_rule, kind.needed = 0, min(2 * kind.needed, _MOST_NEEDED)
                kind.news_ns.clear()

    def _next(self, kind: _Kind) -> Expected | None:
        if kind.since_rule < kind.needed:
            return None
        times_ns = list(kind.news_ns)
        intervals_ns = [later - earlier for earlier, later in pairwise(times_ns)]
        spread_ns, mean_ns = max(intervals_ns) - min(intervals_ns), sum(intervals_ns) // len(intervals_ns)
        if mean_ns < LEAST_INTERVAL_NS or spread_ns > max(SPREAD_NS, SPREAD_SHARE * mean_ns):
            return None
        return Expected(times_ns[-1] + mean_ns, spread_ns, kind.from_bps, kind.to_bps)


def _is_same(one_bps: float, other_bps: float) -> bool:
    """Whether two rates are one."""
    return 1 / SAME_RATIO < one_bps / other_bps < SAME_RATIO

"""The rate between changes: it follows what arrivals tell, but not far from where a change put it."""

from __future__ import annotations

FOLLOW = 0.5  # how far the rate follows its average at each report
DRIFT_RATIO = 1.18  # and how far it may get from where a change put it, before that counts as one
CENTRE_FOLLOWS = 0.002  # a link that changes slowly moves that too


class FollowedRate:
    """centre_bps: where the last change put the rate, more or less."""

    __slots__ = ("_centre_bps",)

    def __init__(self) -> None:
        self._centre_bps = 0.0

    def restart(self, rate_bps: float) -> None:
        """The link has changed to this rate."""
        self._centre_bps = rate_bps

    def follow(self, rate_bps: float, average_bps: float) -> tuple[float, bool]:
        """The rate now, and whether arrivals tell of another one than it may drift to.

        Of less, too: where the link is not full they only tell how slowly we send.
        """
        rate_bps += FOLLOW * (average_bps - rate_bps)
        beyond = not 1 / DRIFT_RATIO < rate_bps / self._centre_bps < DRIFT_RATIO
        rate_bps = min(self._centre_bps * DRIFT_RATIO, max(self._centre_bps / DRIFT_RATIO, rate_bps))
        self._centre_bps += CENTRE_FOLLOWS * (rate_bps - self._centre_bps)
        return rate_bps, beyond

"""How often something may happen, whoever asks for it: an integer token bucket."""

from __future__ import annotations

_NS_PER_S = 1_000_000_000


class RateLimit:
    """At most `burst` at once and `per_s` a second in the long run."""

    __slots__ = ("_burst_ns", "_cost_ns", "_credit_ns", "_refilled_ns")

    def __init__(self, per_s: int, burst: int, now_ns: int) -> None:
        self._cost_ns = _NS_PER_S // per_s
        self._burst_ns = burst * self._cost_ns
        self._credit_ns = self._burst_ns
        self._refilled_ns = now_ns

    def allows(self, now_ns: int) -> bool:
        """Whether it may happen now; if so, it is taken to happen."""
        self._credit_ns = min(self._burst_ns, self._credit_ns + now_ns - self._refilled_ns)
        self._refilled_ns = now_ns
        if self._credit_ns < self._cost_ns:
            return False
        self._credit_ns -= self._cost_ns
        return True

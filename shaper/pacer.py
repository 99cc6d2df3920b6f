"""The token bucket that spaces departures: never more than rate x time + burst on the wire."""

from __future__ import annotations

from typing import Protocol

NS_PER_S = 1_000_000_000


class Pacing(Protocol):
    """Says when a datagram may leave."""

    def may_send(self, now_ns: int) -> bool:
        """Whether one may leave now."""

    def next_send_at_ns(self, now_ns: int) -> int:
        """The earliest time at which `may_send` holds, if nothing is sent before."""

    def urgent_at_ns(self, now_ns: int) -> int:
        """The same for classes with always_send."""

    def on_sent(self, wire_bytes: int, now_ns: int) -> None:
        """A datagram leaves, headers included, whether or not it was allowed to."""


class Pacer:
    """A token bucket counted in integers: credit in bit-nanoseconds, waits rounded up.

    A datagram may leave while the credit is not negative, and then takes its bits out of it. So over
    any interval t the wire carries at most `rate_bps * t + 8 * (credit_bytes + one datagram)` bits.
    `credit_bytes` is what an idle or a late sender may catch up; it absorbs an event loop's lateness.
    Token bucket terms: RFC 2697; spacing departures: RFC 9002 section 7.7.
    """

    __slots__ = ("_credit", "_credit_limit", "_updated_ns", "rate_bps")

    def __init__(self, rate_bps: int, credit_bytes: int, now_ns: int = 0) -> None:
        self.rate_bps = rate_bps
        self._credit_limit = credit_bytes * 8 * NS_PER_S
        self._credit = self._credit_limit
        self._updated_ns = now_ns

    def set_rate(self, rate_bps: int, credit_bytes: int, now_ns: int) -> None:
        """Change the rate from now on; debt stays owed in bits, spare credit is cut to the new limit."""
        self._refill(now_ns)
        self.rate_bps = rate_bps
        self._credit_limit = credit_bytes * 8 * NS_PER_S
        self._credit = min(self._credit, self._credit_limit)

    def may_send(self, now_ns: int) -> bool:
        """Whether a datagram may leave now."""
        self._refill(now_ns)
        return self._credit >= 0

    def on_sent(self, wire_bytes: int, now_ns: int) -> None:
        """Charge a datagram, IP and UDP headers included, whether or not it was allowed to leave."""
        self._refill(now_ns)
        self._credit -= wire_bytes * 8 * NS_PER_S

    def next_send_at_ns(self, now_ns: int) -> int:
        """The earliest time at which `may_send` holds, if nothing is sent before."""
        self._refill(now_ns)
        if self._credit >= 0:
            return now_ns
        return now_ns - (self._credit // self.rate_bps)  # floor of a negative number: the wait rounds up

    def urgent_at_ns(self, now_ns: int) -> int:
        """The same: the bucket is never in debt by more than a datagram."""
        return self.next_send_at_ns(now_ns)

    def _refill(self, now_ns: int) -> None:
        elapsed_ns = now_ns - self._updated_ns
        if elapsed_ns > 0:
            self._credit = min(self._credit_limit, self._credit + elapsed_ns * self.rate_bps)
            self._updated_ns = now_ns

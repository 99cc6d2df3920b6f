"""The link's queue as the sender computes it; departures are paced by it.

A bottleneck of known rate holds what was sent and not yet served. Pacing by that figure instead of by a
round trip's news takes the round trip out of the control loop (O. Smith's predictor, 1957); reports only
correct it. A late timer costs nothing: the computed queue drains meanwhile.
"""

from __future__ import annotations

NS_PER_S = 1_000_000_000
URGENT_INTERVAL_NS = 60_000_000  # what must always pass waits no longer than this for the queue to drain ...
LONGEST_PAUSE_NS = 95_000_000  # that what must always pass waits for: a heartbeat of 10 Hz is not replaced
URGENT_BYTES, URGENT_SHARE = 130, 0.3  # ... or than keeps it, a heartbeat's size each, to this share


class VirtualQueue:
    """What the link is taken to hold, in bit-nanoseconds: integers, so that runs are identical.

    allowance_ns: a datagram may leave once no more than this is left to serve before it.
    not_before_ns: nothing leaves before, whatever the queue says. free: so many datagrams leave as soon as
    free_from_ns, whatever it says.
    urgent_from_ns: what must always pass waits until then too; it is kept to a share of urgent_bps.
    """

    __slots__ = (
        "_level",
        "_updated_ns",
        "allowance_ns",
        "found_ns",
        "free",
        "free_from_ns",
        "not_before_ns",
        "rate_bps",
        "sent_bits",
        "sent_ns",
        "urgent_bps",
        "urgent_from_ns",
    )

    def __init__(self, rate_bps: int, allowance_ns: int, now_ns: int) -> None:
        self.rate_bps = self.urgent_bps = rate_bps
        self.allowance_ns = allowance_ns
        self.not_before_ns = self.urgent_from_ns = now_ns
        self.free = self.free_from_ns = 0
        self.found_ns = 0  # what the newest datagram found before it
        self.sent_bits = 0  # in all
        self.sent_ns = now_ns  # when the newest datagram left
        self._level = 0
        self._updated_ns = now_ns

    def may_send(self, now_ns: int) -> bool:
        """Whether a datagram may leave now."""
        return self.opens_ns() <= now_ns

    def next_send_at_ns(self, now_ns: int) -> int:
        """The earliest time at which `may_send` holds, if nothing is sent before."""
        return max(now_ns, self.opens_ns())

    def urgent_at_ns(self, now_ns: int) -> int:
        """The earliest time for what always passes: it does not wait for the queue to drain."""
        opens_ns = self.opens_ns()
        if opens_ns <= now_ns:
            return max(self.urgent_from_ns, now_ns)
        share_ns = int(URGENT_BYTES * 8 * NS_PER_S / (URGENT_SHARE * self.urgent_bps))
        urgent_ns = self.sent_ns + max(URGENT_INTERVAL_NS, share_ns)
        return max(self.urgent_from_ns, min(max(now_ns, urgent_ns), opens_ns))

    def pause(self, until_ns: int) -> None:
        """Let nothing leave, to measure; what must always pass waits too unless that is for long."""
        self.not_before_ns = until_ns
        if until_ns - self.sent_ns < LONGEST_PAUSE_NS:
            self.urgent_from_ns = until_ns

    def opens_ns(self) -> int:
        """When a datagram may leave, or since when it may have."""
        if self.free > 0:
            return max(self._updated_ns, self.free_from_ns)
        empty_ns = self._updated_ns - (-self._level // self.rate_bps)
        return max(self.not_before_ns, empty_ns - self.allowance_ns)

    def on_sent(self, wire_bytes: int, now_ns: int) -> None:
        """Charge a datagram, IP and UDP headers included, whether or not it was allowed to leave."""
        self.found_ns = self.wait_ns(now_ns)
        self.sent_ns = now_ns
        self.sent_bits += wire_bytes * 8
        self._level += wire_bytes * 8 * NS_PER_S
        if now_ns >= self.free_from_ns:
            self.free = max(0, self.free - 1)

    def wait_ns(self, now_ns: int) -> int:
        """How long until all that was sent has been served, rounded up."""
        elapsed_ns = now_ns - self._updated_ns
        if elapsed_ns > 0:
            self._level = max(0, self._level - elapsed_ns * self.rate_bps)
            self._updated_ns = now_ns
        return -(-self._level // self.rate_bps)

    @property
    def level_ns(self) -> int:
        """The queue when it was last looked at."""
        return -(-self._level // self.rate_bps)

    def set(self, rate_bps: int, wait_ns: int, now_ns: int, urgent_bps: int = 0) -> None:
        """What the link serves, and how long until it has served what it holds.

        urgent_bps: what it may serve, where the rate is but a cautious guess.
        """
        self.rate_bps = rate_bps
        self.urgent_bps = max(rate_bps, urgent_bps)
        self._level = max(0, wait_ns) * rate_bps
        self._updated_ns = now_ns

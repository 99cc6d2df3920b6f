"""When a replay owes each message, what capture time it claims, and how late it was."""

from __future__ import annotations

from typing import Literal

from mcap.records import Message

NS_PER_S = 1_000_000_000
# A log whose publish_time is further from log_time than this was stamped by another clock (or 0).
_SAME_CLOCK_NS = 10 * NS_PER_S


class Pass:
    """One pass over the log: when each message is due, and the capture time it then claims."""

    def __init__(
        self, rate: float, stamp: Literal["now", "log"], log_origin_ns: int, origin_ns: int, wall_ns: int
    ) -> None:
        self.rate = rate
        self.stamp = stamp
        self.log_origin_ns = log_origin_ns
        self.origin_ns = origin_ns
        self.wall_ns = wall_ns
        self.clock_difference_ns: int | None = None

    def offset_ns(self, log_time_ns: int) -> int:
        elapsed_ns = log_time_ns - self.log_origin_ns
        return elapsed_ns if self.rate == 1.0 else round(elapsed_ns / self.rate)

    def capture_ns(self, message: Message, offset_ns: int) -> int:
        """The message's capture time; with "now", as old at its put as it was at its log time.

        At rate 1 that is publish_time plus one constant of the pass. Where log_time and publish_time
        come from different clocks (or publish_time is absent), only differences between capture times
        count, and the first message is as if captured now.
        """
        if self.stamp == "log":
            return message.publish_time
        age_ns = message.log_time - message.publish_time
        if self.clock_difference_ns is None:
            self.clock_difference_ns = 0 if 0 <= age_ns <= _SAME_CLOCK_NS else age_ns
        return self.wall_ns + offset_ns - (age_ns - self.clock_difference_ns)


class Lateness:
    """A histogram of 0.1 ms bins up to 1 s: quantiles of any number of messages in flat memory."""

    BIN_NS = 100_000
    BINS = 10_000

    def __init__(self) -> None:
        self.counts = [0] * (self.BINS + 1)
        self.max_ns = 0

    def add(self, late_ns: int) -> None:
        self.counts[min(max(late_ns, 0) // self.BIN_NS, self.BINS)] += 1
        self.max_ns = max(self.max_ns, late_ns)

    def quantile_ms(self, share: float) -> float:
        """Upper edge of the bin that holds the quantile, at most the maximum; 0 without messages."""
        needed = share * sum(self.counts)
        passed = 0
        for index, count in enumerate(self.counts):
            passed += count
            if count and passed >= needed:
                edge_ns = (index + 1) * self.BIN_NS if index < self.BINS else self.max_ns
                return min(edge_ns, self.max_ns) / 1e6
        return 0.0

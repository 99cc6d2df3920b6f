"""A host's clocks in virtual time: each with its own offset and drift, as real hosts have."""

from __future__ import annotations

from dataclasses import dataclass

_PPM = 1_000_000


@dataclass(frozen=True, slots=True)
class HostClock:
    """How a host's monotonic and wall clocks follow true time; integers, so that runs are identical.

    offset_ns: monotonic clock at true time 0. drift_ppm: how much faster it runs than true time.
    unix_ns: wall clock at true time 0; it drifts with the monotonic clock.
    """

    offset_ns: int = 0
    drift_ppm: int = 0
    unix_ns: int = 0

    def local_ns(self, true_ns: int) -> int:
        """The monotonic clock at a true time."""
        return self.offset_ns + true_ns + true_ns * self.drift_ppm // _PPM

    def true_ns(self, local_ns: int) -> int:
        """The earliest true time at which the monotonic clock shows at least this."""
        elapsed_ns = local_ns - self.offset_ns
        true_ns = elapsed_ns * _PPM // (_PPM + self.drift_ppm) - 1
        while self.local_ns(true_ns) < local_ns:
            true_ns += 1
        return true_ns

    def unix_at_ns(self, local_ns: int) -> int:
        """The wall clock when the monotonic clock shows local_ns."""
        return local_ns - self.offset_ns + self.unix_ns

    def true_of_unix_ns(self, unix_ns: int) -> int:
        """The true time of an instant on the wall clock."""
        return self.true_ns(unix_ns - self.unix_ns + self.offset_ns)

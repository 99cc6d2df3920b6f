"""What arrivals since a change tell of the queue that it left in the link.

After a fall the link holds seconds of what was sent before anyone knew. How much of it is left is told by how
much later the newest datagram was than the quickest: neither the rate nor the delay of the new band need be
known well for that. Where the delay has fallen too, the first ones of the new band arrive in a clump, behind
the last of the old one; the link had begun to serve them long before, one after the other.
"""

from __future__ import annotations

from collections.abc import Sequence

from shaper.estimation.dispersion import FASTEST_BPS
from shaper.estimation.flights import Flight, Flights

NS_PER_S = 1_000_000_000


class NewBand:
    """Told of all arrivals while the link's delay is not known."""

    __slots__ = ("_ahead_bits", "_clump", "_last", "_quickest", "_quickest_ahead")

    def __init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """The link may have changed once more."""
        self._last: Flight | None = None
        self._clump: Flight | None = None  # the first of those that came together with the last
        self._ahead_bits = 0  # of the clump, before the last
        self._quickest: Flight | None = None
        self._quickest_ahead: tuple[int, int] = (0, 0)  # bits before it in its clump, and since when (ns)

    def on_arrived(
        self, arrived: Sequence[Flight], since_ns: int, rate_bps: float, old_ns: int | None, margin_ns: float
    ) -> None:
        """Look at what left since the change, but not at what took as long as in the old band.

        old_ns: the delay of the old band's empty link, if it is known. rate_bps: of the old or the new band.
        """
        for flight in arrived:
            if flight.sent_ns < since_ns:
                continue
            clump = self._follow_clump(flight)
            delay_ns = flight.delay_ns(rate_bps)
            if old_ns is not None and abs(delay_ns - old_ns - flight.wait_ns) < margin_ns:
                continue
            if self._quickest is None or delay_ns < self._quickest.delay_ns(rate_bps):
                self._quickest = flight
                long = flight.sent_ns - clump.sent_ns > margin_ns
                self._quickest_ahead = (self._ahead_bits, clump.sent_ns) if long else (0, flight.sent_ns)

    def queue_ns(self, flights: Flights, rate_bps: float, now_ns: int) -> int:
        """What the link still holds, by the queue of the newest arrival and what left after that."""
        newest = flights.acked[-1]
        queue_ns = flights.simulate(rate_bps, newest, self._wait_ns(newest, rate_bps), now_ns)
        return min(queue_ns, flights.most_queue_ns(rate_bps))

    def _wait_ns(self, newest: Flight, rate_bps: float) -> int:
        """The queue that the newest arrival has met, at least."""
        quickest = self._quickest
        if quickest is None:
            return 0
        ahead_bits, since_ns = self._quickest_ahead
        ahead_ns = int(ahead_bits * NS_PER_S / rate_bps) - (quickest.sent_ns - since_ns)
        return max(0, newest.delay_ns(rate_bps) - quickest.delay_ns(rate_bps) + max(0, ahead_ns))

    def _follow_clump(self, flight: Flight) -> Flight:
        """The first of the clump that this one came in, or right behind; itself, if it came alone."""
        last, clump, self._last = self._last, self._clump, flight
        assert flight.arrived_ns is not None, "it has arrived"
        if last is not None and clump is not None:
            assert last.arrived_ns is not None, "so has the one before it"
            together = (flight.arrived_ns - last.arrived_ns) * FASTEST_BPS <= flight.bits * NS_PER_S
            if together or last is not clump:
                self._ahead_bits += last.bits
                self._clump = clump if together else None
                return clump
        self._clump, self._ahead_bits = flight, 0
        return flight

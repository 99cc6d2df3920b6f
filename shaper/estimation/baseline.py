"""The delay of the empty link, and how it is kept true.

It cannot be read off while there is a queue, and nobody tells whether there is one. So the sender makes
sure: every few seconds it lets the computed queue run empty, waits a little longer, and looks. What is met
then is the empty link, unless waiting has brought the delay down: then there was more queue than computed,
and the pause is repeated, longer. A pause into which something urgent leaves begins anew. Clock drift and
route changes of either sign are followed so; a delay that is higher by far is looked at twice.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise

from shaper.estimation.flights import Flight
from shaper.estimation.virtual_queue import VirtualQueue

PAUSE_NS = 10_000_000  # beyond the computed end of the queue
CHANGE_PAUSE_NS = 40_000_000  # after a change, when the queue is less sure
MAX_PAUSE_NS = 400_000_000
INTERVAL_NS = 5_000_000_000  # between pauses: 10 ms of 5 s are 0.2 % of the link
SOON_NS = 200_000_000  # after a change
PUT_OFF_NS = 500_000_000  # a pause may begin anew for so long in all
RAISED_NS = 3_000_000  # a base higher by this, and the noise, is believed the second time
_SAMPLE_NOISE_NS = 800_000  # one arrival more is looked at per this much noise
_MAX_SAMPLES = 10
IDLE_NS = 5_000_000  # arrivals this much further apart than they take to serve: the link had run empty ...
_SO_NOISY = 4.0  # ... and this many times the noise of one arrival
_ALIKE = 3  # so many that met an empty link, and took longer by far than the base: it is too low


class Baseline:
    """The one-way delay of the empty link plus the peer's clock offset; None while it is not known."""

    def __init__(self, now_ns: int) -> None:
        self.delay_ns: int | None = None
        self.pause_ns = PAUSE_NS
        self.due_ns = now_ns
        self.verified = False  # whether the delay was looked at twice since the last change
        self._before_ns = 0
        self._from_ns: int | None = None  # what leaves from then on meets the empty link
        self._latest_ns = 0  # which it does not put off beyond this
        self._raised = False  # whether the last pause showed a much higher delay
        self._delays_ns: list[int] = []
        self._idle_delays_ns: list[int] = []  # of what met an empty link, and took longer by far

    @property
    def pausing(self) -> bool:
        """Whether a pause has been made whose outcome is awaited."""
        return self._from_ns is not None

    def begin(self, from_ns: int, before_ns: int) -> None:
        """The link is empty from then on. before_ns: what the link seemed to have for delay lately."""
        self._from_ns = from_ns
        self._latest_ns = from_ns + PUT_OFF_NS
        self._before_ns = before_ns
        self._delays_ns = []

    def make_pauses(
        self, pacer: VirtualQueue, empty_ns: int, idle_ns: int, apparent_ns: Callable[[], int], now_ns: int
    ) -> None:
        """A datagram has left: pause behind it if that is due, and use the pauses that traffic makes itself.

        empty_ns: when the queue runs empty now. idle_ns: for how long it was as the datagram left.
        apparent_ns: the delay that the link seems to have.
        """
        if self.pausing:
            if now_ns < pacer.not_before_ns:  # what has just left was urgent
                pacer.pause(self.put_off(empty_ns + self.pause_ns))
        elif idle_ns >= self.pause_ns:
            self.begin(now_ns, apparent_ns())
        elif now_ns >= self.due_ns:
            pacer.pause(empty_ns + self.pause_ns)
            self.begin(pacer.not_before_ns, apparent_ns())

    def put_off(self, from_ns: int) -> int:
        """Something has left in the pause and is served until shortly before then; the pause's new end."""
        assert self._from_ns is not None, "there is a pause"
        self._from_ns = max(self._from_ns, min(from_ns, self._latest_ns))
        return self._from_ns

    def restart(self, from_ns: int) -> None:
        """The link has changed; nothing is known until the first arrivals of what leaves from then on."""
        self.delay_ns, self.verified = None, False
        self._idle_delays_ns.clear()
        self.pause_ns = CHANGE_PAUSE_NS
        self.begin(from_ns, -(1 << 62))

    def lower(self, delay_ns: int) -> int:
        """A delay without any queue is no more than any delay; by how much this one lowers it."""
        if self.delay_ns is None or delay_ns >= self.delay_ns:
            return 0
        fall_ns, self.delay_ns = self.delay_ns - delay_ns, delay_ns
        return fall_ns

    def look_for_idle(self, newest_first: Iterable[Flight], rate_bps: float, noise_ns: float) -> None:
        """Raise a delay that is too low: what comes after the link has run empty met no queue.

        newest_first: what a report told of, and the one before it.
        """
        if self.delay_ns is None:
            return
        margin_ns = IDLE_NS + _SO_NOISY * noise_ns
        for after, before in pairwise(newest_first):
            if after.number != before.number + 1 or not self._ran_empty(before, after, rate_bps, margin_ns):
                continue
            delay_ns = after.delay_ns(rate_bps)
            if delay_ns - self.delay_ns < 2 * margin_ns:
                self._idle_delays_ns.clear()
                continue
            self._idle_delays_ns.append(delay_ns)
        if len(self._idle_delays_ns) >= _ALIKE:
            self.delay_ns = min(self._idle_delays_ns)
            self._idle_delays_ns.clear()

    @staticmethod
    def _ran_empty(before: Flight, after: Flight, rate_bps: float, margin_ns: float) -> bool:
        """Whether the link served one, and then nothing until the other came."""
        assert before.arrived_ns is not None and after.arrived_ns is not None, "both have arrived"
        served_ns = (after.bits + after.bits_before) * 1e9 / rate_bps
        if after.arrived_ns - before.arrived_ns < served_ns + margin_ns:
            return False
        # Else what was served more slowly than the rate has it would look like that.
        return after.delay_ns(rate_bps) - before.delay_ns(rate_bps) < margin_ns / 2

    def on_arrived(self, arrived: Sequence[Flight], rate_bps: float, noise_ns: float, now_ns: int) -> bool:
        """Whether the outcome of a pause is known by now; then delay_ns is set by it."""
        if self._from_ns is None:
            return False
        needed = min(_MAX_SAMPLES, 1 + int(noise_ns / _SAMPLE_NOISE_NS))
        for flight in arrived:
            if flight.sent_ns >= self._from_ns:
                self._delays_ns.append(flight.delay_ns(rate_bps) - flight.wait_ns)
        if len(self._delays_ns) < needed:
            return False
        after_ns, self._from_ns = min(self._delays_ns), None
        if self.delay_ns is not None:
            self._raised = after_ns - self.delay_ns > RAISED_NS + 1.5 * noise_ns and not self._raised
            if self._raised:
                self.due_ns = now_ns
                return True
        hidden = self._before_ns - after_ns > max(self.pause_ns / 2, 1.5 * noise_ns)
        first = self.delay_ns is None
        self.verified = not first
        self.delay_ns = after_ns
        if hidden:
            self.pause_ns = min(MAX_PAUSE_NS, 2 * self.pause_ns)
        elif not first:
            self.pause_ns = PAUSE_NS
        self.due_ns = now_ns + (0 if hidden else SOON_NS if first else INTERVAL_NS)
        return True

"""Trains: small datagrams at once, whose spacing on arrival tells the rate. When to send one, how long."""

from __future__ import annotations

from shaper.estimation.round_trips import RoundTrips
from shaper.estimation.virtual_queue import VirtualQueue

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000

TRAIN_DATAGRAMS = 3
MOST_LONGER, LONGER_NOISE_NS = 5, 1_200_000  # one more per this much noise of arrivals, and so many at most
TRAIN_INTERVAL_NS = 20 * NS_PER_MS  # at least, from the end of one to the start of the next
START_INTERVAL_NS, MAX_START_INTERVAL_NS = 300 * NS_PER_MS, 3 * NS_PER_S  # while no train was reported
ANSWER_NS, ANSWER_RTTS = 1 * NS_PER_S, 2  # trains not reported for so long are lost, or wait in a queue
CAUTION = 10  # trains follow each other as if the link had become so many times slower ...
LEAST_CAUTIOUS_BPS = 8_000  # but hardly slower than the slowest link that we are made for
DOUBT_NS, DOUBT_RTTS = 1 * NS_PER_S, 4  # for so long a link that has become quicker is measured by trains


def probing_bps(known_bps: float) -> float:
    """The rate at which trains follow each other on a link that last carried known_bps."""
    return max(known_bps / CAUTION, min(known_bps, LEAST_CAUTIOUS_BPS))


class Trains:
    """interval_ns: between those that search for the rate. In run they leave only while it is in doubt.

    left: how many datagrams of the present one have not left yet. enough: whether the link is taken for what
    it was, and no more of them are needed.
    """

    __slots__ = (
        "_answer_by_ns",
        "_doubt_until_ns",
        "_last_number",
        "_sent_ns",
        "enough",
        "interval_ns",
        "left",
    )

    def __init__(self, now_ns: int, *, hinted: bool) -> None:
        self.left = 0
        self.enough = False
        self.interval_ns = TRAIN_INTERVAL_NS if hinted else START_INTERVAL_NS
        self._last_number = -1  # of the newest datagram of a train
        self._sent_ns = self._doubt_until_ns = self._answer_by_ns = now_ns

    def begin(self, pacer: VirtualQueue, datagrams: int = TRAIN_DATAGRAMS) -> None:
        """The next ones to leave are a train."""
        self.left = pacer.free = datagrams

    def stop(self, pacer: VirtualQueue) -> None:
        """There is none any more."""
        self.left = pacer.free = pacer.free_from_ns = 0
        self.enough = False

    def need_no_more(self) -> None:
        """The link is taken for what it was: what leaves after this train tells its rate as well."""
        self.interval_ns, self.enough = 0, True

    def are_needed(self, now_ns: int) -> bool:
        """Whether another one is to follow."""
        return not self.enough or self.is_overdue(now_ns)

    def next_at_ns(self, opens_ns: int) -> int:
        """When the next datagram of a train leaves, if the pacer opens then."""
        return max(opens_ns, self._answer_by_ns + 1) if self.enough and not self.left else opens_ns

    def on_sent(self, number: int, pacer: VirtualQueue, now_ns: int) -> bool:
        """A datagram has left; whether it was of a train."""
        of_train = self.left > 0 and now_ns >= pacer.free_from_ns
        if of_train:
            self.left -= 1
            self._last_number = number
        return of_train

    def pace(
        self, of_train: bool, empty_ns: int, nothing_known: bool, pacer: VirtualQueue, now_ns: int
    ) -> None:
        """They leave whole, and one after the other has been served at the cautious rate, at empty_ns."""
        if not self.are_needed(now_ns):
            return
        if not of_train and now_ns >= pacer.not_before_ns:
            self.begin(pacer, TRAIN_DATAGRAMS - 1)
        elif of_train and self.left == 0:
            pacer.pause(empty_ns + self.interval_ns)
            if nothing_known or self.is_overdue(now_ns):  # wait for an answer, ever longer
                self.wait_longer()

    def wait_longer(self) -> None:
        """No answer has come yet."""
        self.interval_ns = min(max(TRAIN_INTERVAL_NS, 2 * self.interval_ns), MAX_START_INTERVAL_NS)

    def await_answer(self, newest_rtt_ns: int, now_ns: int) -> None:
        """Trains begin to leave: word of them should come in time."""
        self._answer_by_ns = now_ns + ANSWER_NS + ANSWER_RTTS * newest_rtt_ns

    def on_answer(self, nothing_known: bool, rtts: RoundTrips, now_ns: int) -> None:
        """Trains have been reported: those that waited for that may follow each other again."""
        if nothing_known or self.is_overdue(now_ns):
            self.interval_ns = max(TRAIN_INTERVAL_NS, rtts.shortest_ns // 2)
        self.await_answer(rtts.newest_ns, now_ns)

    def are_all_reported(self, number: int) -> bool:
        """Whether none is on its way any more, by the newest reported number; told once."""
        told = 0 <= self._last_number <= number
        if told:
            self._last_number = -1
        return told

    def is_overdue(self, now_ns: int) -> bool:
        """Whether they may be filling a buffer, or go nowhere."""
        return now_ns > self._answer_by_ns

    def doubt(self, shortest_rtt_ns: int, now_ns: int) -> None:
        """The link may carry more than it did: send trains for a while to see."""
        self._doubt_until_ns = now_ns + DOUBT_NS + DOUBT_RTTS * shortest_rtt_ns

    def next_length(self, not_before_ns: int, newest_rtt_ns: int, noise_ns: float, now_ns: int) -> int:
        """How many datagrams the train has that leaves now; 0: none does. At most two per round trip."""
        interval_ns = max(TRAIN_INTERVAL_NS * 3, newest_rtt_ns // 2)
        if not max(not_before_ns, self._sent_ns + interval_ns) < now_ns < self._doubt_until_ns:
            return 0
        self._sent_ns = now_ns
        return TRAIN_DATAGRAMS + min(MOST_LONGER, int(noise_ns / LONGER_NOISE_NS))

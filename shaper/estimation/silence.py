"""Silence of the peer, and delay of the way back: the earliest news that a link has changed.

Each datagram promises when the next one follows. A promise that runs out says that the way back has
changed, or the way there, half a round trip before any report could.
"""

from __future__ import annotations

import math
from collections import deque

from shaper.frames import NUMBER_BITS
from shaper.loss import LossMeter
from shaper.path import HeardPacket
from shaper.serial_number import expand

_MARGIN_NS = 4_000_000  # a timer's lateness, on either side
_NOISE_FACTOR = 6.0
_FALSE_ALARMS = 2e-4  # chance that so many datagrams in a row are lost
HICCUPS = 3e-3  # and that so many of the peer's are, which costs no more than until the next one
_LEAST_LOSS = 0.005
_LATE_NS = 20_000_000  # what ends a hiccup is later than its predecessor by no more than this ...
_LATE_SHARE = 0.35  # ... or this share of the silence
_SAME_NS = 5_000_000
_AS_EVER_NS = 10_000_000  # a queue of the peer's is as long
_QUICKEST_OF = 64
_SETTLED_AFTER = 32  # datagrams that were no later: no queue of the peer's is draining
_LARGEST_NS = 200_000_000  # that a backlog's datagram may take: a small one's successor may be so large
_LARGEST_OF = 32  # how many of the peer's datagrams are sure to have had a large one among them
HICCUP_NS = 300_000_000  # a longer silence is none
_FALL_NS = 20_000_000  # of the delay back, which says that the path has changed ...
_CLUMP_NS = 25_000_000  # ... against what came earlier: where the order is kept it falls in small steps
_NEVER_NS = 1 << 62


class Silence:
    """Watches the way back."""

    def __init__(self) -> None:
        self.heard_ns = -_NEVER_NS
        self.deadline_ns = _NEVER_NS  # beyond it the peer is silent
        self.misses = 1  # datagrams in a row that must fail to come before that is more than loss
        self.same = False  # whether the newest datagram took as long as the one before it
        self.later_ns = 0  # how much longer it took
        self.quickened = False  # whether it took less than any of late, which is no queue that drains
        self.as_ever = False  # whether it took as long as the quickest of late, but for its size
        self.unbroken = False  # whether it also follows that one, so that the peer itself was late
        self._largest_ns = 0  # the longest promise of late: what the peer's largest datagrams take
        self._largest_since_ns = self._counted = 0  # that of those counted
        self._number = -1
        self._loss = LossMeter()
        self._delay_us: int | None = None  # of the newest datagram, plus the clocks' offset
        self._quickest_us: tuple[int, ...] = ()  # the least delays of late, less what it took to serve, ...
        self._compared = 0  # ... of one to two times so many datagrams, and of the newest up to so many
        self._fresh: deque[tuple[int, int]] = deque()  # when the next of those came, and their delays
        self._promise_ns = 0
        self._least_us = 0
        self._deviation_us = 0.0

    @property
    def noise_ns(self) -> float:
        """Sigma of the delay back."""
        return 1250.0 * self._deviation_us

    def needed_misses(self, loss_ratio: float, chance: float = _FALSE_ALARMS) -> int:
        """How many datagrams in a row must fail to come before that is more than loss."""
        if loss_ratio < _LEAST_LOSS:
            return 1
        return min(12, math.ceil(math.log(chance) / math.log(min(loss_ratio, 0.5))))

    def on_heard(self, packet: HeardPacket, now_ns: int) -> tuple[bool, bool]:
        """A datagram has come: whether it was late against the last, and whether the path is quicker."""
        number, promise_ns = packet.number, packet.promise_ns
        number = expand(number, NUMBER_BITS, self._number) if self._number >= 0 else number
        if self._number >= 0 and 0 < number - self._number < 64 and now_ns < self.deadline_ns:
            for _ in range(number - self._number - 1):
                self._loss.on_settled(lost=True)
            self._loss.on_settled(lost=False)
        follows = self._number >= 0 and number == self._number + 1
        self._number = max(self._number, number)
        late, quicker = self._judge_delay(now_ns // 1000 - packet.sent_us, promise_ns, now_ns - self.heard_ns)
        self._compare_with_the_quickest(packet, now_ns, late=late)
        self.heard_ns = now_ns
        self.unbroken = follows and self.same
        self.misses = self.needed_misses(self._loss.ratio, HICCUPS)
        if promise_ns <= _LARGEST_NS:  # a longer one is of an idle peer
            self._note_size(promise_ns)
        margin_ns = _MARGIN_NS + max(int(_NOISE_FACTOR * self.noise_ns), self._largest_ns - promise_ns)
        self.deadline_ns = now_ns + self.misses * promise_ns + margin_ns
        return late, quicker

    def _compare_with_the_quickest(self, packet: HeardPacket, now_ns: int, *, late: bool) -> None:
        """What it took to serve is known by the rate that the peer has told."""
        self.quickened = False
        if not packet.peer_bps:
            self.as_ever = self.same
            return
        served_us = packet.wire_bytes * 8_000_000 // packet.peer_bps
        delay_us = now_ns // 1000 - packet.sent_us - served_us
        off_ns = min(abs(delay_us - quickest_us) for quickest_us in self._quickest_us or (delay_us,)) * 1000
        self.as_ever = off_ns < max(_AS_EVER_NS, _NOISE_FACTOR * self.noise_ns)
        self._pass_fresh(now_ns)
        if self._quickest_us and not late:
            fallen_ns = (min(self._quickest_us) - delay_us) * 1000
            fall_ns = _FALL_NS + _NOISE_FACTOR * self.noise_ns
            self.quickened = self._compared >= _SETTLED_AFTER and fallen_ns > fall_ns
        if late or self.quickened or not self._quickest_us:
            self._quickest_us, self._compared = (delay_us, delay_us), 0
            self._fresh.clear()
        else:
            self._fresh.append((now_ns, delay_us))

    def _pass_fresh(self, now_ns: int) -> None:
        """What came a while ago is what the next ones are compared with; those of a clump are not."""
        while self._fresh and self._fresh[0][0] < now_ns - _CLUMP_NS:
            delay_us = self._fresh.popleft()[1]
            former_us, newest_us = self._quickest_us
            drains = (min(former_us, newest_us) - delay_us) * 1000 > _SAME_NS
            self._compared = 0 if drains else self._compared + 1
            if self._compared % _QUICKEST_OF == 0:
                former_us, newest_us = newest_us, delay_us
            self._quickest_us = min(former_us, delay_us), min(newest_us, delay_us)

    def _note_size(self, promise_ns: int) -> None:
        """Of a backlog: what the datagram itself takes."""
        self._largest_since_ns = max(self._largest_since_ns, promise_ns)
        self._largest_ns = max(self._largest_ns, promise_ns)
        self._counted += 1
        if self._counted == _LARGEST_OF:
            self._largest_ns, self._largest_since_ns, self._counted = self._largest_since_ns, 0, 0

    def on_peer_restarted(self) -> None:
        """Another clock, other numbers."""
        self._number, self._delay_us, self._quickest_us = -1, None, ()
        self._fresh.clear()

    def _judge_delay(self, delay_us: int, promise_ns: int, silence_ns: int) -> tuple[bool, bool]:
        """A larger datagram takes longer; in a backlog the next one follows it later by just that."""
        larger_ns, self._promise_ns = promise_ns - self._promise_ns, promise_ns
        if self._delay_us is None:
            self._delay_us = self._least_us = delay_us
            return False, False
        later_ns = (delay_us - self._delay_us) * 1000
        self.later_ns = later_ns = min(later_ns, later_ns - larger_ns, key=abs)
        allowed_ns = max(_LATE_NS, _NOISE_FACTOR * self.noise_ns, _LATE_SHARE * silence_ns, self._largest_ns)
        off_us = min(abs(later_ns) / 1000, 3 * self._deviation_us + 500)
        self._deviation_us += (off_us - self._deviation_us) / 16
        self._delay_us = delay_us
        self.same = abs(later_ns) < max(_SAME_NS, _NOISE_FACTOR * self.noise_ns)
        quicker = (self._least_us - delay_us) * 1000 > _FALL_NS + _NOISE_FACTOR * self.noise_ns
        self._least_us = min(self._least_us + 1 + silence_ns // 1_000_000_000, delay_us)
        if later_ns > allowed_ns:
            self._least_us = delay_us
        return later_ns > allowed_ns, quicker

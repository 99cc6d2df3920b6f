"""Which life of the peer is the present one: it may be killed and start anew at any time.

Without a channel that vouches for it, whoever says hello under an epoch of his own is taken for the peer
started anew; with one, the channel alone decides.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from shaper.incoming import Incoming
from shaper.journal import Journal
from shaper.settled import Settled

_RETIRED_EPOCHS = 8  # former lives whose late datagrams are recognised


class PeerLives:
    """The present life and what is remembered of those before it.

    make: an Incoming for a life with this epoch. journal, max_topics: what outlives both processes.
    """

    def __init__(
        self, make: Callable[[int, Settled | None], Incoming], journal: Journal | None, max_topics: int
    ) -> None:
        self.present: Incoming | None = None
        self.vouched = False  # the channel says which life is the present one
        self._make = make
        self._journal = journal
        self._max_topics = max_topics
        self._memory = b"" if journal is None else journal.peer_memory
        self._settled: Settled | None = None
        self._former: Incoming | None = None  # the life before, should it turn out to be the present one
        self._retired: deque[int] = deque(maxlen=_RETIRED_EPOCHS)

    def vouch(self, epoch: int, memory: bytes) -> bool:
        """The channel names the present life; whether that is news."""
        self.vouched = True
        return self.present is None or (epoch, memory) != (self.present.epoch, self._memory)

    def remember(self, memory: bytes) -> bool:
        """The present life has this memory; whether it is that of the life before."""
        remembers = memory == self._memory
        self._memory = memory
        if self._journal is not None:
            if not remembers:
                self._journal.meet(memory)
            if self._settled is None or not remembers:
                self._settled = Settled(self._journal, memory, self._max_topics)
        return remembers

    def may_begin(self, epoch: int, *, dark: bool) -> bool:
        """Whether a hello under an epoch that is not the peer's may be the peer's all the same.

        A former one's is not, unless the present one has fallen silent: then it was a late or a forged
        datagram by which we took the peer for restarted.
        """
        if self.present is None:
            return True
        return not self.vouched and (epoch not in self._retired or dark)

    def begin(self, epoch: int) -> Incoming:
        """This life is the present one from now on."""
        former, self._former = self._former, None if self.vouched else self.present
        if self.present is not None:
            self._retired.append(self.present.epoch)
            if epoch in self._retired:
                self._retired.remove(epoch)
        if former is None or self.vouched or former.epoch != epoch:
            former = self._make(epoch, self._settled)
        self.present = former
        return former

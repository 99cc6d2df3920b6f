"""Each end tells the other its counters, once a second in a few bytes, so that both know the whole."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from shaper.frames import LedgerFrame
from shaper.incoming import Incoming
from shaper.ledger import ReceivedLedger, SentLedger
from shaper.outgoing import Outgoing

_ROWS_PER_BEAT = 4  # of each half; about 15 bytes a row: a thin band has better things to carry


class LedgerExchange:
    """The peer's counters as far as it has told them, and what it has been told of ours.

    Rows that have changed since they were last told go first, in turn. Counters are totals, so a lost
    row is made good by the next one of its topic.
    """

    def __init__(self, epoch: int) -> None:
        self.sent: dict[str, SentLedger] = {}  # of the topics that come to us, as the peer counts them
        self.received: dict[str, ReceivedLedger] = {}  # of the topics that we send, as they arrive there
        self._epoch = epoch
        self._told_sent: dict[int, tuple[int, ...]] = {}
        self._told_received: dict[int, tuple[int, ...]] = {}

    def on_peer_restarted(self) -> None:
        """The peer has to be told everything anew."""
        self._told_sent.clear()
        self._told_received.clear()
        self.sent.clear()
        self.received.clear()

    def take(self, outgoing: Outgoing, incoming: Incoming) -> Iterator[LedgerFrame]:
        """What to tell now."""
        sent = ((topic_id, queue.ledger.counters()) for topic_id, queue in outgoing.identified())
        rows = _changed(sent, self._told_sent)
        if rows:
            yield LedgerFrame(self._epoch, True, rows)
        received = ((topic_id, ledger.counters()) for topic_id, ledger in incoming.received_rows())
        rows = _changed(received, self._told_received)
        if rows:
            yield LedgerFrame(incoming.epoch, False, rows)

    def on_sent_half(self, frame: LedgerFrame, incoming: Incoming) -> None:
        """The peer tells the counters of its own topics."""
        for topic_id, counters in frame.rows:
            key = incoming.key_of(topic_id)
            if key is not None and frame.epoch == incoming.epoch:
                self.sent[key] = SentLedger(*counters)

    def on_received_half(self, frame: LedgerFrame, outgoing: Outgoing) -> None:
        """The peer tells what has come of our topics."""
        for topic_id, counters in frame.rows:
            queue = outgoing.queue_of(topic_id)
            if queue is not None:
                delivered, lost, stale, expired, received_bytes, unreadable = counters
                self.received[queue.key] = ReceivedLedger(
                    delivered, lost, stale, expired, received_bytes, unreadable
                )


def _changed(
    rows: Iterable[tuple[int, tuple[int, ...]]], told: dict[int, tuple[int, ...]]
) -> tuple[tuple[int, tuple[int, ...]], ...]:
    """Rows that differ from what was told, the longest untold first."""
    changed = {topic_id: counters for topic_id, counters in rows if told.get(topic_id) != counters}
    never = [topic_id for topic_id in changed if topic_id not in told]
    order = never + [topic_id for topic_id in told if topic_id in changed]
    chosen = order[:_ROWS_PER_BEAT]
    for topic_id in chosen:
        told.pop(topic_id, None)
        told[topic_id] = changed[topic_id]
    return tuple((topic_id, changed[topic_id]) for topic_id in chosen)

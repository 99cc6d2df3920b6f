"""Topics whose messages are coded against one that has arrived: `latest` with a stream encoding."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from messages.payload import Encoded, StreamEncoding
from messages.payload import Payload as BusPayload
from shaper.events import Event
from shaper.path import Content
from shaper.queues import Piece, TopicQueue, Waiting
from shaper.traffic_class import TopicRule


@dataclass(frozen=True, slots=True)
class _SentSample:
    queue: StreamQueue
    number: int

    def on_arrived(self) -> None:
        self.queue.writer.on_arrived(self.number)

    def on_lost(self) -> None:
        """Nothing: the next message does without it."""


class StreamQueue(TopicQueue):
    """A queue whose messages are coded when they leave, against the newest that the peer has by then."""

    __slots__ = ("_packed", "writer")

    def __init__(
        self,
        key: str,
        rule: TopicRule,
        encoding: StreamEncoding,
        wake: Callable[[TopicQueue], None],
        tell: Callable[[Event], None],
    ) -> None:
        super().__init__(key, rule, wake, tell)
        self.writer = encoding.writer()
        self._packed: Waiting | None = None  # what departs, as it was offered

    def _encode(self, message: Waiting) -> Encoded:
        self._packed = message
        return self.writer.encode(BusPayload(bytes(message.payload), message.encoding), self.next_number)

    def sent(self, piece: Piece, count: int, loss_ratio: float = 0.0) -> Content | None:
        """A message that leaves whole is held by the peer as soon as its datagram has arrived."""
        departure = piece.departure
        is_whole = departure.protected is None and count == len(departure.data)
        super().sent(piece, count, loss_ratio)
        return _SentSample(self, departure.number) if is_whole else None

    def on_peer_restarted(self) -> None:
        """The peer has none of what we referred to: what departs is coded anew, unless a newer one waits."""
        self.writer.on_receiver_restarted()
        if self.departing is None:
            return
        self.departing = None
        if self.waiting or self._packed is None:
            self.ledger.superseded += 1
        else:
            self.waiting.append(self._packed)

"""What there is room for: budgets for publishers, and topics that are asked for when they may leave."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from shaper.events import Event, ReceiptStage
from shaper.path import Content
from shaper.pulled import Fates
from shaper.queues import Payload, Piece, TopicQueue
from shaper.traffic_class import TopicRule

WINDOW_NS = 4_000_000_000  # over which the use by higher tiers is averaged
PULL_TIMEOUT_NS = 2_000_000_000  # a request without an answer is forgotten after this
_MIN_BUDGET_BYTES = 256
_DEFAULT_PULL_PERIOD_NS = 1_000_000_000
_NS_PER_S = 1_000_000_000


class Demand:
    """How many bytes a tier can expect to send, from the rate and what higher tiers took of it lately."""

    def __init__(self) -> None:
        self._sent: deque[tuple[int, int, int]] = deque()  # (when, tier, bytes)
        self._by_tier: dict[int, int] = {}

    def on_sent(self, tier: int, sent_bytes: int, now_ns: int) -> None:
        """A tier has sent message bytes."""
        self._sent.append((now_ns, tier, sent_bytes))
        self._by_tier[tier] = self._by_tier.get(tier, 0) + sent_bytes
        self._forget(now_ns)

    def budget_bytes(self, tier: int, rate_bps: int, period_ns: int, now_ns: int) -> int:
        """What a topic of this tier may make in a period; never below 256 bytes."""
        self._forget(now_ns)
        higher_bytes = sum(count for number, count in self._by_tier.items() if number < tier)
        left_bps = rate_bps - higher_bytes * 8 * _NS_PER_S // WINDOW_NS
        return max(_MIN_BUDGET_BYTES, left_bps * period_ns // (8 * _NS_PER_S))

    def _forget(self, now_ns: int) -> None:
        sent = self._sent
        while sent and sent[0][0] < now_ns - WINDOW_NS:
            _, tier, count = sent.popleft()
            self._by_tier[tier] -= count


class PullQueue(TopicQueue):
    """A topic without a publisher: its newest item is asked for when it is its turn to leave.

    The queue counts as having something to send once its period has passed. When it is served it asks
    instead; the answer comes by `offer` and leaves at its next turn. An item that does not come within
    two seconds is asked for anew. Its publisher is told what becomes of it.
    """

    __slots__ = ("_fates", "asked_ns", "wanted")

    def __init__(
        self,
        key: str,
        rule: TopicRule,
        wake: Callable[[TopicQueue], None],
        tell: Callable[[Event], None] = lambda event: None,
    ) -> None:
        super().__init__(key, rule, wake, tell)
        self.wanted = False  # the turn has come: the driver is to ask
        self.asked_ns: int | None = None  # since when an answer is awaited
        self._fates = Fates(key, tell)

    def offer(self, payload: Payload, encoding: str, capture_ns: int, now_ns: int, tag: int = 0) -> bool:
        self.asked_ns = None
        self.wanted = False
        waits = super().offer(payload, encoding, capture_ns, now_ns, tag)
        self._fates.tell(tag, ReceiptStage.QUEUED)
        return waits

    def expired(self, tag: int) -> None:
        super().expired(tag)
        self._fates.tell(tag, ReceiptStage.EXPIRED)

    def sent(self, piece: Piece, count: int, loss_ratio: float = 0.0) -> Content | None:
        departure = piece.departure
        part = self._fates.on_sent_part(departure.number, departure.tag)
        super().sent(piece, count, loss_ratio)
        if self.departing is None:
            self._fates.on_sent(departure.number, departure.shares_needed)
        return part

    def on_peer_restarted(self) -> None:
        if self.departing is not None:
            self._fates.forget(self.departing.number)
        super().on_peer_restarted()

    def due(self, now_ns: int) -> bool:
        """An answer is never decimated: the question was."""
        return True

    def next_ask_ns(self) -> int | None:
        """When the next item falls due; None while one waits or is awaited within its time."""
        if self.waiting or self.departing is not None or self.wanted:
            return None
        return self._next_ns if self.asked_ns is None else self.asked_ns + PULL_TIMEOUT_NS

    def ask_if_due(self, now_ns: int) -> bool:
        """Want an item if its time has come; whether it has."""
        ask_ns = self.next_ask_ns()
        if ask_ns is None or ask_ns > now_ns:
            return False
        self._next_ns = now_ns + (self.rule.min_period_ns or _DEFAULT_PULL_PERIOD_NS)
        self.wanted = True
        return True

    def ask(self, now_ns: int) -> None:
        """The turn has come and the driver is told to ask."""
        self.wanted = False
        self.asked_ns = now_ns

    @property
    def empty(self) -> bool:
        return not self.wanted and super().empty

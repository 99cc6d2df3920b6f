"""Who is next: strict priority between tiers with guaranteed shares, fairness in bytes inside one."""

from __future__ import annotations

from collections.abc import Mapping
from heapq import heappop, heappush

from shaper.queues import TopicQueue

EMERGENCY_TIER = 0
_PER_MILLION = 1_000_000
_VIRTUAL_PER_BYTE = 1_000_000  # at weight 1; so fine that no weight rounds a small message to nothing


class _Tier:
    """The topics of one tier, by start-time fair queueing (Goyal, Vin, Cheng: SIGCOMM 1996).

    Each topic's messages carry virtual start and finish times that advance by bytes / weight; the
    smallest start is next. A topic that was idle starts at the tier's present, so nothing is hoarded,
    and one that has just had a large message waits until the others have had as much.
    """

    __slots__ = ("always", "current", "heap", "owed", "share", "virtual_now")

    def __init__(self, share: int) -> None:
        self.share = share  # guaranteed, in millionths
        self.owed = 0  # bytes x million that the guarantee is behind
        self.heap: list[tuple[int, int, TopicQueue]] = []
        # Those that always may leave, by key, as they stand in the heap while they are active: few of many.
        self.always: dict[str, tuple[int, int, TopicQueue]] = {}
        self.current: TopicQueue | None = None  # whose message is under way
        self.virtual_now = 0


class Scheduler:
    """Queues that have something to send.

    A message under way keeps its tier's turn until its last part has left; only another tier comes
    between: a higher one, or one whose guaranteed share is behind.
    guaranteed: share (0..1) of all bytes that a tier gets as long as it has something to send.
    """

    def __init__(self, guaranteed: Mapping[int, float] | None = None) -> None:
        self._guaranteed = {t: round(s * _PER_MILLION) for t, s in (guaranteed or {}).items()}
        self._tiers: dict[int, _Tier] = {}
        self._ordered: list[_Tier] = []  # by number, without the emergency stop's
        self._arrivals = 0  # order of arrival, for equal virtual times

    def activate(self, queue: TopicQueue) -> None:
        """Put a queue that has got something to send in line."""
        if queue.active:
            return
        queue.active = True
        number = queue.rule.traffic_class.tier
        tier = self._tiers.get(number)
        if tier is None:
            tier = self._tiers[number] = _Tier(self._guaranteed.get(number, 0))
            self._ordered = [t for n, t in sorted(self._tiers.items()) if n != EMERGENCY_TIER]
        self._line_up(tier, queue)

    def next_queue(
        self, *, only_always_send: bool = False, only_emergency: bool = False
    ) -> TopicQueue | None:
        """The queue to serve now, or None if nothing may leave."""
        emergency = self._tiers.get(EMERGENCY_TIER)
        if emergency is not None:
            queue = self._head(emergency, only_always_send)
            if queue is not None:
                return queue
        if only_emergency:
            return None
        tiers = [*self._owed(), *self._ordered] if self._guaranteed else self._ordered
        for tier in tiers:
            if tier.heap or tier.current is not None:
                queue = self._head(tier, only_always_send)
                if queue is not None:
                    return queue
        return None

    @property
    def has_emergency(self) -> bool:
        """Whether there may be an emergency stop to send."""
        return EMERGENCY_TIER in self._tiers

    def _owed(self) -> list[_Tier]:
        """Tiers whose guaranteed share is behind."""
        tiers = (self._tiers.get(number) for number in self._guaranteed)
        return [tier for tier in tiers if tier is not None and tier.owed > 0]

    def on_sent(self, queue: TopicQueue, sent_bytes: int) -> None:
        """Bytes of this queue's message, its frame included, are in a datagram."""
        served = self._tiers[queue.rule.traffic_class.tier]
        queue.virtual_finish += round(sent_bytes * _VIRTUAL_PER_BYTE / queue.rule.weight)
        served.current = queue
        for number in self._guaranteed:
            tier = self._tiers.get(number)
            if tier is None:
                continue
            if tier is served:
                tier.owed -= sent_bytes * (_PER_MILLION - tier.share)
            elif self._head(tier, False) is None:
                tier.owed = 0
            else:
                tier.owed += sent_bytes * tier.share

    def message_done(self, queue: TopicQueue) -> None:
        """A message has left whole or was given up: the tier's next topic has its turn."""
        tier = self._tiers[queue.rule.traffic_class.tier]
        if tier.current is queue:
            tier.current = None
        if tier.heap and tier.heap[0][2] is queue:
            heappop(tier.heap)
        else:  # served out of turn while the link was held
            tier.heap = [item for item in tier.heap if item[2] is not queue]
            tier.heap.sort()
        self._line_up(tier, queue)

    def _line_up(self, tier: _Tier, queue: TopicQueue) -> None:
        queue.virtual_finish = max(queue.virtual_finish, tier.virtual_now)
        self._arrivals += 1
        item = (queue.virtual_finish, self._arrivals, queue)
        heappush(tier.heap, item)
        if queue.rule.traffic_class.always_send:
            tier.always[queue.key] = item

    def _head(self, tier: _Tier, only_always_send: bool) -> TopicQueue | None:
        current = tier.current
        if current is not None and (current.empty or not current.message_under_way):
            tier.current = current = None
        if not only_always_send:
            if current is not None:
                return current
            heap = tier.heap
            while heap:
                start, _, queue = heap[0]
                if not queue.empty:
                    tier.virtual_now = max(tier.virtual_now, start)
                    return queue
                heappop(heap)
                queue.active = False
            return None
        waiting = [item for item in tier.always.values() if item[2].active and not item[2].empty]
        return min(waiting)[2] if waiting else None

"""Who is next: strict priority between tiers, turn by turn inside one."""

from __future__ import annotations

from collections import deque

from shaper.queues import TopicQueue

EMERGENCY_TIER = 0


class Scheduler:
    """Queues that have something to send, by tier.

    Inside a tier each topic sends one message and goes to the end of the line; a message in several
    datagrams keeps its place until its last part has left, and only a higher tier comes between.
    """

    def __init__(self) -> None:
        self._tiers: dict[int, deque[TopicQueue]] = {}
        self._order: list[int] = []

    def activate(self, queue: TopicQueue) -> None:
        """Put a queue that has just got something to send in line."""
        if queue.active:
            return
        queue.active = True
        tier = queue.rule.traffic_class.tier
        line = self._tiers.get(tier)
        if line is None:
            line = self._tiers[tier] = deque()
            self._order = sorted(self._tiers)
        line.append(queue)

    def next_queue(
        self, *, only_always_send: bool = False, only_emergency: bool = False
    ) -> TopicQueue | None:
        """The queue to serve now, or None if nothing may leave."""
        for tier in self._order:
            if only_emergency and tier != EMERGENCY_TIER:
                return None
            line = self._tiers[tier]
            while line and line[0].empty:
                line.popleft().active = False
            if not line:
                continue
            if not only_always_send:
                return line[0]
            for queue in line:
                if queue.rule.traffic_class.always_send and not queue.empty:
                    return queue
        return None

    def message_done(self, queue: TopicQueue) -> None:
        """A message has left whole, or was given up: the next topic of the tier has its turn."""
        line = self._tiers[queue.rule.traffic_class.tier]
        if line[0] is queue:
            line.rotate(-1)
        else:  # served out of turn while the link was held
            line.remove(queue)
            line.append(queue)

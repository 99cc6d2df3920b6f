"""Whose turn it is: what the next datagram is for, and when it may leave."""

from __future__ import annotations

from typing import NamedTuple

from shaper.incoming import Incoming
from shaper.link_estimator import LinkEstimator
from shaper.outgoing import Outgoing
from shaper.path import Path
from shaper.queues import TopicQueue
from shaper.timers import NOTHING_DUE, Due, Timers

_SHORTLY_NS = 100_000_000  # a pause as short as a heartbeat of 10 Hz can wait for
_ANY_TIME_NS = -(1 << 62)  # before any clock


class Turn(NamedTuple):
    """A datagram that leaves now. queue: whose message goes first; None if only what is due does.

    holding, only_emergency: of messages only those that always may leave, or only an emergency stop.
    probe_bytes: of a datagram that is sent to be timed; 0 for any other.
    """

    queue: TopicQueue | None
    due: Due
    holding: bool
    only_emergency: bool
    probe_bytes: int


class Turns:
    """What waits, what is due without a message, and what the pacer and the trickle let pass.

    incoming: the peer's present life; None before it was heard.
    """

    __slots__ = ("_estimator", "_outgoing", "_path", "_timers", "incoming")

    def __init__(self, estimator: LinkEstimator, outgoing: Outgoing, path: Path, timers: Timers) -> None:
        self.incoming: Incoming | None = None
        self._estimator = estimator
        self._outgoing = outgoing
        self._path = path
        self._timers = timers

    @property
    def holding(self) -> bool:
        """Whether only classes with always_send may leave: no peer heard yet, or enough in flight."""
        return self.incoming is None or self._path.bytes_in_flight >= self._estimator.in_flight_limit_bytes

    def next_turn(self, now_ns: int) -> Turn | None:
        """What leaves now, or None."""
        if self._is_shut(now_ns):
            return None
        pacer, scheduler = self._estimator.pacer, self._outgoing.scheduler
        trickle_ns, opens_ns = self._trickle_at_ns(), pacer.next_send_at_ns(now_ns)
        gated = now_ns < max(opens_ns, trickle_ns)
        only_emergency = now_ns < max(pacer.urgent_at_ns(now_ns), trickle_ns)
        holding = gated or self.holding
        queue = scheduler.next_queue(only_always_send=holding, only_emergency=only_emergency)
        due = self._what_is_due(now_ns, gated=gated)
        if queue is None and due.anything and opens_ns < now_ns + _SHORTLY_NS and not self.holding:
            # What leaves in a short pause takes along what must pass, which would have to wait for it else.
            only_emergency = False
            queue = scheduler.next_queue(only_always_send=True)
        probe_bytes = 0 if gated else self._estimator.probe_bytes(now_ns)
        if queue is None and not due.anything and not probe_bytes:
            return None
        return Turn(queue, due, holding, only_emergency, probe_bytes)

    def wakeup_at_ns(self, now_ns: int) -> int:
        """When something falls due or may leave, if nothing happens before."""
        scheduler, pacer, trickle_ns = self._outgoing.scheduler, self._estimator.pacer, self._trickle_at_ns()
        opens_ns, urgent_ns = pacer.next_send_at_ns(now_ns), pacer.urgent_at_ns(now_ns)
        wakeup_ns = opens_ns
        waits = scheduler.next_queue(only_always_send=self.holding) is not None
        if not waits or urgent_ns > opens_ns:  # else whatever is due leaves with what waits
            wakeup_ns = min(self._timers.beat_at_ns, urgent_ns) if waits else self._timers.beat_at_ns
            for at_ns in (self._report_due_ns(), self._probe_at_ns()):
                if at_ns is not None and at_ns < wakeup_ns:
                    wakeup_ns = at_ns
        wakeup_ns = max(wakeup_ns, opens_ns, trickle_ns)
        if scheduler.next_queue(only_always_send=True) is not None:
            wakeup_ns = max(min(wakeup_ns, max(urgent_ns, trickle_ns)), now_ns + 1)
        promised_ns = self._timers.promised_until_ns
        for at_ns in (self._estimator.wakeup_at_ns(), self._outgoing.wants_at_ns(), promised_ns):
            if at_ns is not None and at_ns < wakeup_ns:
                wakeup_ns = max(at_ns, now_ns + 1)
        return wakeup_ns

    def promise_code(self, now_ns: int) -> int:
        """How soon the next datagram follows, as its code; the timers keep to it."""
        waits = self._outgoing.scheduler.next_queue(only_always_send=self.holding) is not None
        backlog_at_ns = self._estimator.pacer.next_send_at_ns(now_ns) if waits else None
        return self._timers.promise_code(
            self.incoming, backlog_at_ns, self._report_interval_ns(idle=not waits), now_ns
        )

    def _is_shut(self, now_ns: int) -> bool:
        """Whether nothing at all may leave: mostly so, when something has come between two datagrams."""
        pacer = self._estimator.pacer
        return (
            now_ns < pacer.next_send_at_ns(now_ns)
            and now_ns < pacer.urgent_at_ns(now_ns)
            and now_ns < self._timers.promised_until_ns
            and not self._outgoing.scheduler.has_emergency
        )

    def _what_is_due(self, now_ns: int, *, gated: bool) -> Due:
        """gated: the link has no room; what was promised leaves all the same."""
        promised = now_ns >= self._timers.promised_until_ns
        if gated:
            return Due(promised=True) if promised else NOTHING_DUE
        report_ns, probe_ns = self._report_due_ns(), self._probe_at_ns()
        return Due(
            beat=now_ns >= self._timers.beat_at_ns,
            report=report_ns is not None and report_ns <= now_ns,
            probe=probe_ns is not None and probe_ns <= now_ns,
            promised=promised,
        )

    def _trickle_at_ns(self) -> int:
        if self.incoming is None or self._estimator.trickles:
            return _ANY_TIME_NS
        return self._timers.trickle_at_ns(self._estimator.rate_bps)

    def _probe_at_ns(self) -> int | None:
        if self.incoming is None:
            return None
        waits = self._outgoing.scheduler.next_queue() is not None if self.holding else False
        if not waits and not self._outgoing.awaits_outcomes:
            return None
        return self._timers.probe_at_ns(self._path, self._estimator.rate_bps)

    def _report_interval_ns(self, *, idle: bool) -> int:
        return self._timers.report_interval_ns(self.incoming, self._estimator.rate_bps, idle=idle)

    def _report_due_ns(self) -> int | None:
        if self.incoming is None or not self.incoming.has_unreported:
            return None
        idle = self._outgoing.scheduler.next_queue() is None
        return self._timers.report_due_ns(self.incoming, self._report_interval_ns(idle=idle))

"""One end of the link: the only class that a driver talks to. No I/O; time is an argument.

Three things happen to an endpoint: the bus offers it a message, the link brings it a datagram, its
timer runs out. After each of them the driver calls `pump`, which sends what may leave and hands over
what has happened, and says when to come back. The same class runs live, in virtual time and in tests.
"""

from __future__ import annotations

from collections import deque
from dataclasses import asdict

from shaper.control_frames import ControlFrames
from shaper.datagram import append_hello, append_padding, decode_datagram, write_header
from shaper.endpoint_settings import Counters, EndpointSettings
from shaper.errors import DecodeError
from shaper.estimate_exchange import link_state
from shaper.events import Event, LinkState, PeerStarted, Wanted
from shaper.frames import (
    HEADER_BYTES,
    IP_UDP_BYTES,
    Header,
    HelloFrame,
    MessageFrame,
    PaddingFrame,
    ReportFrame,
    SkipFrame,
)
from shaper.incoming import Incoming
from shaper.journal import Journal
from shaper.ledger import ReceivedLedger, SentLedger
from shaper.ledger_exchange import LedgerExchange
from shaper.link_estimator import LinkEstimator
from shaper.outgoing import Opportunity, Outgoing
from shaper.pacer import NS_PER_S
from shaper.path import Content, HeardPacket, Path, PeerClock
from shaper.path_mtu import PathMtu
from shaper.peer_lives import PeerLives
from shaper.promise import PROMISES_NS
from shaper.queues import Payload, TopicQueue
from shaper.settled import Settled
from shaper.timers import Due, Timers
from shaper.turns import Turns

TOLD_SHARE = 0.02  # a rate that changes by less is told with the next beat


class Endpoint:
    """Shapes one side's traffic onto the link and rebuilds the other side's from it.

    epoch: a random 16-bit number, new at each start, by which the peer notices a restart.
    now_ns: a monotonic clock of this host; unix_ns: its wall clock at the same instant. journal: what is
    remembered of reliable messages when the process is killed; of use only behind a secure channel, which
    tells whether the peer is the one that the journal knows.
    """

    def __init__(
        self,
        settings: EndpointSettings,
        estimator: LinkEstimator,
        epoch: int,
        now_ns: int,
        unix_ns: int,
        journal: Journal | None = None,
    ) -> None:
        limits = settings.limits
        self.counters = Counters()
        self.received_ledgers: dict[str, ReceivedLedger] = {}
        self._settings = settings
        self._outer_bytes = IP_UDP_BYTES + settings.protection_bytes
        self.path_mtu = PathMtu(settings.max_datagram_bytes)
        self._epoch = epoch
        self._estimator = estimator
        self._unix_minus_monotonic_ns = unix_ns - now_ns
        self._outgoing = Outgoing(
            settings.rules, limits.max_topics, limits.max_message_bytes, settings.guaranteed, journal
        )
        self._refused_here: tuple[str, ...] = ()
        self._lives = PeerLives(self._make_incoming, journal, limits.max_topics)
        self._incoming: Incoming | None = None  # the present life
        self._path = Path()
        self._told = False, estimator.rate_bps  # whether it holds, and the rate
        self._events: deque[Event] = deque()
        self._timers = Timers(now_ns)
        self._turns = Turns(estimator, self._outgoing, self._path, self._timers)
        self._control = ControlFrames(epoch, self._outgoing, self._timers)
        self._outgoing.restore(now_ns)

    # What happens to an endpoint.

    def offer(
        self,
        key: str,
        payload: Payload,
        capture_ns: int,
        now_ns: int,
        encoding: str = "",
        tag: int = 0,
    ) -> bool:
        """A local publisher has a message. capture_ns: on this host's monotonic clock.

        tag: comes back in the receipts of a reliable message. False if nothing more waits than before
        (dropped, or put in the place of an older sample): then there is nothing to pump, which is what
        makes thousands of unwanted messages a second cheap.
        """
        return self._outgoing.offer(key, payload, encoding, capture_ns, now_ns, tag)

    def missed(self, key: str, count: int) -> None:
        """Count offers of a `latest` topic that newer ones replaced before they came to be made."""
        self._outgoing.missed(key, count)

    def receive_datagram(self, data: bytes, now_ns: int) -> None:
        """The link has brought a datagram. Malformed ones are counted, never raised."""
        self.counters.received_datagrams += 1
        self.counters.received_wire_bytes += len(data) + self._outer_bytes
        try:
            self._receive(data, now_ns)
        except DecodeError:
            self.counters.malformed += 1

    def on_peer_authenticated(self, epoch: int, memory: bytes, now_ns: int) -> None:
        """The channel vouches for the peer's present life: speak to it before it has said anything.

        memory: what it remembers of reliable messages; the same as before if nothing was forgotten.
        """
        if not self._lives.vouch(epoch, memory):
            return
        remembers = self._lives.remember(memory)
        if self._incoming is None and not remembers:
            self._outgoing.on_peer_restarted()  # what was left of a former life of ours
        self._meet_peer(epoch, now_ns, remembers=remembers)

    def refuse(self, here: tuple[str, ...], there: tuple[str, ...]) -> None:
        """The two sides do not mean these topics alike: key expressions of the peer's, and of ours."""
        self._refused_here = here
        self._outgoing.refuse(there)
        if self._incoming is not None:
            self._incoming.refuse(here)

    def on_channel_sent(self, datagram_bytes: int, now_ns: int) -> None:
        """The channel has sent something of its own: it takes its part of the link too."""
        wire_bytes = datagram_bytes + IP_UDP_BYTES
        self._estimator.pacer.on_sent(wire_bytes, now_ns)
        self.counters.sent_datagrams += 1
        self.counters.sent_wire_bytes += wire_bytes

    def on_timer(self, now_ns: int) -> None:
        """The time that `pump` returned has come."""
        self._outgoing.want_what_is_due(now_ns)
        wakeup_ns = self._estimator.wakeup_at_ns()
        if wakeup_ns is not None and wakeup_ns <= now_ns:
            self._estimator.on_timer(now_ns)
            self._tell_estimate()

    def set_wall_clock(self, unix_ns: int, now_ns: int) -> None:
        """The wall clock may have been stepped; capture times are told to the peer by it."""
        self._unix_minus_monotonic_ns = unix_ns - now_ns

    # What comes out of it; `pump` drains both.

    def next_datagram(self, now_ns: int) -> bytes | None:
        """The next datagram that may leave now, or None."""
        turn = self._turns.next_turn(now_ns)
        if turn is None:
            return None
        queue, due, holding, only_emergency, probe_bytes = turn
        out = bytearray(HEADER_BYTES)
        said_hello, contents = self._append_control(out, now_ns, due)
        has_messages = False
        if queue is not None:
            has_messages, more = self._outgoing.fill(
                out,
                Opportunity(
                    limit_bytes=self._limit_bytes(0 if holding else probe_bytes),
                    max_bytes=self._settings.max_datagram_bytes - self._settings.protection_bytes,
                    rate_bps=self._estimator.rate_bps,
                    loss_ratio=self._path.loss_ratio,
                    now_ns=now_ns,
                    only_always_send=holding,
                    only_emergency=only_emergency,
                    timed=probe_bytes > 0,
                ),
            )
            contents += more
            self._ask_for_what_is_wanted(now_ns)
        if probe_bytes:
            append_padding(out, PaddingFrame(max(0, probe_bytes - self._outer_bytes - len(out))))
        elif len(out) == HEADER_BYTES and not due.promised:
            return None  # what waited has expired, or is to be asked for first
        elicits_report = has_messages or said_hello or bool(contents) or probe_bytes > 0
        return self._seal(out, now_ns, contents, elicits_report=elicits_report)

    def next_event(self) -> Event | None:
        """The oldest event not handed over yet, or None."""
        if self._outgoing.events:
            self._events.extend(self._outgoing.events)
            self._outgoing.events.clear()
        return self._events.popleft() if self._events else None

    def wakeup_at_ns(self, now_ns: int) -> int:
        """When something falls due or may leave, if nothing happens before."""
        return self._turns.wakeup_at_ns(now_ns)

    # What drivers and people look at.

    @property
    def packet_number(self) -> int:
        """Of the datagram that `next_datagram` gave last, in full."""
        return self._path.next_number - 1

    @property
    def wanted_bytes(self) -> int:
        """UDP payload of a full datagram at this rate, if the path takes it."""
        return min(self._settings.max_datagram_bytes, self._estimator.datagram_bytes - IP_UDP_BYTES)

    @property
    def holding(self) -> bool:
        """Whether only classes with always_send may leave: no peer heard yet, or enough in flight."""
        return self._turns.holding

    def budget_bytes(self, queue: TopicQueue, now_ns: int) -> int:
        """What a topic may make per period, by the rate and what higher tiers took of it lately."""
        rule = queue.rule
        period_ns = rule.min_period_ns or NS_PER_S
        rate_bps = self._estimator.rate_bps
        budget = self._outgoing.demand.budget_bytes(rule.traffic_class.tier, rate_bps, period_ns, now_ns)
        return min(budget, self._settings.limits.max_message_bytes)

    def demands(self, now_ns: int) -> dict[str, tuple[int, int]]:
        """Per topic: the bytes that a message may have now, and the period (ns) for which that holds."""
        return {
            queue.key: (self.budget_bytes(queue, now_ns), queue.rule.min_period_ns or NS_PER_S)
            for queue in self._outgoing.queues()
        }

    @property
    def peer_ledgers(self) -> LedgerExchange:
        """What the peer says of its own counters."""
        return self._control.ledgers

    @property
    def peer_clock(self) -> PeerClock | None:
        """The clock of the peer that is heard at present."""
        return self._incoming.clock if self._incoming is not None else None

    def silence_ns(self, now_ns: int) -> int:
        """For how long nothing has come from the peer; since the start if nothing ever has."""
        return now_ns - self._timers.last_heard_ns

    @property
    def held_bytes(self) -> int:
        """What unfinished, waiting and shared messages of the peer's take of our memory."""
        return self._incoming.held_bytes if self._incoming is not None else 0

    def sent_ledgers(self) -> dict[str, SentLedger]:
        """Counters of the topics that this side sends, by key."""
        return self._outgoing.ledgers()

    def counters_dict(self) -> dict[str, int]:
        """Datagrams and drops that belong to no topic."""
        incoming = self._incoming
        return {
            **asdict(self.counters),
            "unmatched": self._outgoing.unmatched,
            "refused_offers": self._outgoing.refused,
            "refused_messages": incoming.refused if incoming else 0,
            "unknown_topics": incoming.unknown_topics if incoming else 0,
            "given_up": incoming.given_up if incoming else 0,
        }

    def link_state(self) -> LinkState:
        """What this side believes of its sending direction."""
        return link_state(self._estimator, self._path, self._control.estimates.theirs, holding=self.holding)

    # Sending.

    def _append_control(self, out: bytearray, now_ns: int, due: Due) -> tuple[bool, tuple[Content, ...]]:
        """Append what the two ends tell each other beside messages; whether that includes a hello."""
        incoming = self._incoming
        contents: tuple[Content, ...] = ()
        if incoming is not None:
            contents = self._control.append(out, incoming, now_ns, report_due=due.report)
        if due.beat:
            self._timers.on_beat(now_ns, searching=incoming is None)
            self._events.append(state := self.link_state())
            if incoming is not None:
                self._control.append_beat(out, incoming, state, now_ns)
        if due.beat or due.probe or not self._path.reported:
            append_hello(out, HelloFrame(now_ns // 1000 * 1000 + self._unix_minus_monotonic_ns))
            return True, contents
        return False, contents

    def _ask_for_what_is_wanted(self, now_ns: int) -> None:
        outgoing = self._outgoing
        while outgoing.wanted:
            queue = outgoing.wanted.popleft()
            self._events.append(Wanted(queue.key, self.budget_bytes(queue, now_ns)))

    def _seal(
        self, out: bytearray, now_ns: int, contents: tuple[Content, ...], *, elicits_report: bool
    ) -> bytes:
        sized = self.path_mtu.watch(len(out) + self._settings.protection_bytes)
        contents = contents if sized is None else (*contents, sized)
        packet = self._path.on_sent(len(out) + self._outer_bytes, now_ns, contents)
        self._estimator.pacer.on_sent(packet.wire_bytes, now_ns)
        self._estimator.on_sent(packet, now_ns)
        promise = self._turns.promise_code(now_ns)
        write_header(out, Header(self._epoch, packet.number, now_ns // 1000, elicits_report, promise))
        self.counters.sent_datagrams += 1
        self.counters.sent_wire_bytes += packet.wire_bytes
        if elicits_report:
            self._timers.last_sent_ns = now_ns
        return bytes(out)

    def _limit_bytes(self, probe_bytes: int) -> int:
        wire_bytes = probe_bytes or self._estimator.datagram_bytes
        return min(wire_bytes, self.path_mtu.size_bytes + IP_UDP_BYTES) - self._outer_bytes

    def _tell_estimate(self) -> None:
        """At once if it has changed by what matters; each beat tells it anyway."""
        holds, rate_bps = self._estimator.in_flight_limit_bytes == 0, self._estimator.rate_bps
        told_holding, told_bps = self._told
        if holds != told_holding or abs(rate_bps - told_bps) > TOLD_SHARE * told_bps:
            self._told = holds, rate_bps
            self._events.append(self.link_state())

    # Receiving.

    def _receive(self, data: bytes, now_ns: int) -> None:
        header, frames = decode_datagram(data)
        incoming = self._incoming
        if incoming is None or header.epoch != incoming.epoch:
            # Whoever has just started says hello in every datagram until it is reported on.
            says_hello = any(isinstance(frame, HelloFrame) for frame in frames)
            may_begin = self._lives.may_begin(header.epoch, dark=self._timers.is_dark(now_ns))
            if incoming is not None and not (says_hello and may_begin):
                self.counters.stale_epoch += 1
                return
            incoming = self._meet_peer(header.epoch, now_ns)
        self._timers.last_heard_ns = now_ns
        sent_us = incoming.accept_packet(header, now_ns)
        if sent_us is None:
            self.counters.duplicate += 1
            return
        for frame in frames:
            match frame:
                case MessageFrame():
                    self._events.extend(incoming.on_message(frame, sent_us, now_ns))
                case SkipFrame():
                    self._events.extend(incoming.on_skip(frame, now_ns))
                case ReportFrame():
                    self._on_report(frame, sent_us, incoming, now_ns)
                case HelloFrame():
                    incoming.on_hello(frame, sent_us)
                case _:
                    self._control.on_frame(frame, incoming, now_ns)
        promise_ns, told_bps = PROMISES_NS[header.promise], self._control.estimates.told_bps
        wire_bytes = len(data) + self._outer_bytes
        packet = HeardPacket(header.number, sent_us, wire_bytes, promise_ns, told_bps)
        self._estimator.on_heard(packet, now_ns)

    def _meet_peer(self, epoch: int, now_ns: int, *, remembers: bool = False) -> Incoming:
        """The peer's first datagram, or the first after it has started anew."""
        again = self._incoming is not None
        if again:
            self._outgoing.on_peer_restarted(remembers=remembers)
            self._control.on_peer_restarted()
            self._path.on_peer_restarted()
            self._estimator.on_peer_restarted(now_ns)
        self._incoming = self._turns.incoming = incoming = self._lives.begin(epoch)
        self._timers.on_peer_met(now_ns)
        self._events.append(PeerStarted(epoch, again))
        return incoming

    def _make_incoming(self, epoch: int, settled: Settled | None) -> Incoming:
        settings, ledgers, tell = self._settings, self.received_ledgers, self._events.append
        incoming = Incoming(
            epoch, settings.limits, settings.accept, ledgers, settings.encodings, tell, settled
        )
        incoming.refuse(self._refused_here)
        return incoming

    def _on_report(self, frame: ReportFrame, sent_us: int, incoming: Incoming, now_ns: int) -> None:
        if frame.epoch != self._epoch:  # it speaks of our former self
            return
        settled = self._path.on_report(frame, sent_us, incoming.clock, now_ns)
        if settled:
            self._timers.report_at_once = False
            self._estimator.on_report(settled, self._path.rtt_ns, self._path.loss_ratio, now_ns)
            self._tell_estimate()

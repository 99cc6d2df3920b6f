"""One end of the link as its driver sees it: the endpoint behind its channel.

The endpoint decides what is said and when, the channel to whom and under which key. Drivers do as with a
bare endpoint: something happens, then `pump_link`, then wait.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from shaper.channel_control import (
    CONTROL_OVERHEAD_BYTES,
    PASSED,
    PROBE,
    decode_passed,
    encode_passed,
    encode_probe,
)
from shaper.endpoint import Endpoint
from shaper.errors import DecodeError
from shaper.events import Event, Receipt
from shaper.handshake import Identity
from shaper.open_channel import OpenChannel
from shaper.operator_lost import OperatorWatch
from shaper.secure_channel import Address, Control, SecureChannel
from shaper.table_exchange import ASK, PART, TableExchange

Channel = SecureChannel | OpenChannel

_MAX_CONTROL = 8
_NEVER_NS = 1 << 62


class LinkEnd:
    """An endpoint and its channel, kept in step."""

    def __init__(
        self,
        endpoint: Endpoint,
        channel: Channel,
        watch: OperatorWatch | None = None,
        tables: TableExchange | None = None,
    ) -> None:
        self.tables = tables
        self.endpoint = endpoint
        self.channel = channel
        if channel.has_control:
            endpoint.path_mtu.start_probing()
        self.watch = watch
        self._events: deque[Event] = deque()
        self._control: deque[bytes] = deque(maxlen=_MAX_CONTROL)  # of a flood of questions some get no answer
        self._copy: tuple[bytes, Address] | None = None  # of what left last, for where the peer may be now
        self._peer: Identity | None = None

    # What happens to it; messages are offered to the endpoint itself.

    def receive(self, data: bytes, source: Address, now_ns: int) -> None:
        """The socket has brought a datagram, from whomever."""
        received = self.channel.receive(data, source, now_ns)
        self._meet(now_ns)
        if isinstance(received, bytes):
            self.endpoint.receive_datagram(received, now_ns)
        elif isinstance(received, Control):
            self._on_control(received.payload, now_ns)

    def on_timer(self, now_ns: int) -> None:
        """The time that `pump_link` returned has come."""
        self.endpoint.on_timer(now_ns)

    def set_wall_clock(self, unix_ns: int, now_ns: int) -> None:
        """The wall clock may have been stepped."""
        self.endpoint.set_wall_clock(unix_ns, now_ns)
        self.channel.set_wall_clock(unix_ns, now_ns)

    # What comes out of it.

    def next_datagram(self, now_ns: int) -> tuple[bytes, Address] | None:
        """The next datagram that may leave now, and where to; None if there is none."""
        if self._copy is not None:
            copy, self._copy = self._copy, None
            self.endpoint.on_channel_sent(len(copy[0]), now_ns)
            return copy
        if self.watch is not None:
            self._look_for_operator(self.watch, now_ns)
        handshake = self.channel.next_handshake(now_ns)
        if handshake is not None:
            self.endpoint.on_channel_sent(len(handshake[0]), now_ns)
            return handshake
        if not self.channel.ready:
            return None
        control = self._next_control(now_ns)
        if control is not None:
            sealed = self.channel.seal_control(control)
            self.endpoint.on_channel_sent(len(sealed), now_ns)
            return sealed, self.channel.peer_address
        datagram = self.endpoint.next_datagram(now_ns)
        if datagram is None:
            return None
        sealed = self.channel.seal(datagram, self.endpoint.packet_number)
        elsewhere = self.channel.copy_to(len(sealed))
        self._copy = None if elsewhere is None else (sealed, elsewhere)
        return sealed, self.channel.peer_address

    def next_event(self) -> Event | None:
        """The oldest event not handed over yet, or None."""
        if self._events:
            return self._events.popleft()
        if self.channel.notices:
            return self.channel.notices.popleft()
        if self.endpoint.path_mtu.notices:
            return self.endpoint.path_mtu.notices.popleft()
        if self.tables is not None and self.tables.notices:
            return self.tables.notices.popleft()
        return self.endpoint.next_event()

    def wakeup_at_ns(self, now_ns: int) -> int:
        """When something falls due or may leave, if nothing happens before."""
        channel, watch = self.channel, self.watch
        due_ns = channel.wakeup_at_ns()
        due_ns = _NEVER_NS if due_ns is None else due_ns
        if watch is not None:
            due_ns = min(due_ns, watch.wakeup_at_ns())
        if not channel.ready:
            return due_ns
        due_ns = min(due_ns, self.endpoint.wakeup_at_ns(now_ns))
        if not channel.has_control:
            return due_ns
        probe_ns = None
        if self._may_probe_sizes:
            probe_ns = self.endpoint.path_mtu.wakeup_at_ns(self.endpoint.wanted_bytes)
        ask_ns = None if self.tables is None else self.tables.wakeup_at_ns()
        for at_ns in (probe_ns, ask_ns):
            if at_ns is not None and at_ns < due_ns:
                due_ns = at_ns
        return due_ns

    def silence_ns(self, now_ns: int) -> int | None:
        """For how long nothing authentic has come from the peer; None if nothing ever has."""
        heard_ns = self.channel.last_heard_ns
        return None if heard_ns is None else now_ns - heard_ns

    def counters_dict(self) -> dict[str, int]:
        """Datagrams and drops of both."""
        return {**self.endpoint.counters_dict(), **self.channel.counters_dict()}

    def _meet(self, now_ns: int) -> None:
        peer = self.channel.peer
        if peer is not None and peer != self._peer:
            self._peer = peer
            self.endpoint.on_peer_authenticated(peer.epoch, peer.memory, now_ns)
            if self.tables is not None:
                self.tables.meet(peer.table_hash, now_ns)

    def _look_for_operator(self, watch: OperatorWatch, now_ns: int) -> None:
        event = watch.look(self.channel.last_heard_ns, now_ns)
        if event is not None:
            self._events.append(event)

    def _next_control(self, now_ns: int) -> bytes | None:
        if not self.channel.has_control:
            return None
        if self._control:
            return self._control.popleft()
        question = None if self.tables is None else self.tables.next_question(now_ns)
        if question is not None:
            return question
        if not self._may_probe_sizes:
            return None
        probe_bytes = self.endpoint.path_mtu.next_probe(self.endpoint.wanted_bytes, now_ns)
        return None if probe_bytes is None else encode_probe(probe_bytes)

    @property
    def _may_probe_sizes(self) -> bool:
        """Not while only a trickle leaves: of a link that is down a probe learns nothing."""
        return not self.endpoint.path_mtu.is_at_ceiling and not self.endpoint.holding

    def _on_control(self, payload: bytes, now_ns: int) -> None:
        """What the peer's channel says; an empty payload only proves that it is there."""
        if not payload:
            return
        try:
            if payload[0] == PROBE:
                self._control.append(encode_passed(len(payload) + CONTROL_OVERHEAD_BYTES))
            elif payload[0] == PASSED:
                self.endpoint.path_mtu.on_probe_arrived(decode_passed(payload), now_ns)
            elif payload[0] == ASK and self.tables is not None:
                self._control.append(self.tables.answer(payload))
            elif payload[0] == PART and self.tables is not None and self.tables.on_part(payload, now_ns):
                self.endpoint.refuse(self.tables.refused_here, self.tables.refused_there)
        except DecodeError:
            self.endpoint.counters.malformed += 1


def pump_link(
    link: LinkEnd,
    now_ns: int,
    send: Callable[[bytes, Address], None],
    handle: Callable[[Event], None],
) -> int:
    """Send what may leave, hand over what has happened; returns when to call `on_timer` and again.

    handle: calls `on_handed_over` of what it has delivered, at once or when it is sure.
    """
    while (outgoing := link.next_datagram(now_ns)) is not None:
        send(*outgoing)
    while (event := link.next_event()) is not None:
        handle(event)
        if isinstance(event, Receipt) and event.on_told is not None:
            event.on_told()
    return link.wakeup_at_ns(now_ns)

"""Who is at the other end, and that nobody else is heard: handshakes, sessions, addresses. No I/O.

A channel starts a handshake when it has no session, when the peer has fallen silent, and when a key has
been used for long. Every completed handshake is a session of its own; datagrams say which one they belong
to, so that keys change, and either side starts anew, without a moment in which nothing can be read. What
cannot be opened changes nothing but a counter. docs/security.md says what this protects against.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from shaper.carousel_wire import decode_clear
from shaper.channel_control import ANSWERED, CHALLENGE, CHALLENGE_BYTES
from shaper.channel_notices import ChannelNotices
from shaper.errors import DecodeError
from shaper.handshake import (
    ANSWER,
    ANSWER_BYTES,
    INITIATION,
    INITIATION_BYTES,
    Hello,
    Identity,
    Side,
    decode_hello,
    encode_hello,
    encode_initiation,
    other_side,
    prologue,
)
from shaper.initiations import Initiations
from shaper.link_key import LinkKey
from shaper.noise import KEY_BYTES, Initiator, Responder
from shaper.notices import Notice
from shaper.session import CLEAR_BYTES, CONTROL, MAX_FORGED, MAX_SEALED, PROTECTED, TAG_BYTES, Session
from shaper.whereabouts import Address, Whereabouts

__all__ = ["Address", "ChannelCounters", "Control", "SecureChannel"]

_NS_PER_S = 1_000_000_000
REKEY_AFTER_NS = 600 * _NS_PER_S
_REKEY_PATIENCE_NS = (
    60 * _NS_PER_S
)  # by which the side that did not start the session lets the other go first
_REKEY_AFTER_SEALED = MAX_SEALED // 2
SILENCE_NS = 3 * _NS_PER_S  # without anything from the peer: it may have lost the session
_FIRST_RETRIES, _FIRST_RETRY_NS = 120, _NS_PER_S // 2
_RETRY_NS, _SILENT_RETRY_NS = _NS_PER_S, 2 * _NS_PER_S
_SILENT_SLOWING = 3  # and no sooner than this share of the silence: a link that stands still keeps them all
_LONGEST_RETRY_NS = 10 * _NS_PER_S
_ONE_ANSWER_NS = _NS_PER_S  # what a peer that we know asks within this is a backlog: one answer serves it
_MAX_ANSWERED = 8  # handshakes that wait for the peer's proof
_MAX_ASKED = 16  # and for its answer: of round trips up to eight seconds
_UNDER_WAY_NS = 60 * _NS_PER_S
_MAX_SESSIONS = 3  # in use, and before it
_OVERLAP_NS = 60 * _NS_PER_S  # for which former keys still open what is late


@dataclass(slots=True)
class ChannelCounters:
    """What came that was not the peer's, and what was done about it."""

    handshakes: int = 0
    strangers: int = 0  # no datagram of any session or handshake
    forged: int = 0  # a session's number, but not its key
    replayed: int = 0
    failed_handshakes: int = 0  # another key, or none
    refused_handshakes: int = 0  # repeated, or more than are answered in a second


@dataclass(frozen=True, slots=True)
class Control:
    """What the peer's channel has to say to ours."""

    payload: bytes


@dataclass(slots=True)
class _Asked:
    """A handshake that we have started."""

    initiator: Initiator
    asked_ns: int
    where: Address


class SecureChannel:
    """One side's half of the protected link.

    keys: the first is the one to start with; all are answered, so that both sides can change keys one
    after the other. peer: where the other side is looked for until it is heard from elsewhere.
    random_bytes: the operating system's, or a seeded generator's in virtual time.
    """

    overhead_bytes = TAG_BYTES
    has_control = True

    def __init__(
        self,
        side: Side,
        keys: Sequence[LinkKey],
        identity: Identity,
        peer: Address,
        random_bytes: Callable[[int], bytes],
        now_ns: int,
        unix_ns: int,
    ) -> None:
        assert keys, "a secure channel needs a key"
        self.counters = ChannelCounters()
        self.last_heard_ns: int | None = None
        self._notices = ChannelNotices(now_ns)
        self._side = side
        self._initiations = Initiations(side, {key.id: key for key in keys}, self._notices, now_ns)
        self.unwanted = self._initiations.unwanted
        self._own_key = keys[0]
        self._identity = identity
        self._whereabouts = Whereabouts(peer, random_bytes)
        self._random = random_bytes
        self._unix_minus_monotonic_ns = unix_ns - now_ns
        self._asked: dict[int, _Asked] = {}  # by our session number
        self._answered: dict[int, Session] = {}  # until the peer proves that it has our answer
        self._sessions: list[Session] = []  # oldest first
        self._current: Session | None = None  # the one to seal with
        self._by_id: dict[int, Session] = {}
        self._to_send: deque[tuple[bytes, Address]] = deque(maxlen=_MAX_ANSWERED)
        self._attempts = 0
        self.numbers_drawn = 0  # for sessions: under each datagrams may come from then on
        self._initiate_at_ns = now_ns
        self._look_at_ns = now_ns  # not before this; whatever is heard only puts it off

    # What drivers and the endpoint look at.

    @property
    def peer_address(self) -> Address:
        """Where datagrams go."""
        return self._whereabouts.address

    @property
    def ready(self) -> bool:
        """Whether datagrams can be sealed."""
        return self._current is not None and not self._current.worn

    @property
    def peer(self) -> Identity | None:
        """What the peer told of itself in the session in use."""
        return self._current.hello.identity if self._current is not None else None

    def session_ids(self) -> list[int]:
        """Numbers under which datagrams may come: for a filter in front of the socket."""
        return [*self._by_id, *self._asked]

    @property
    def peers(self) -> tuple[Address, ...]:
        """Where the peer is and where it is looked for."""
        return tuple({self._whereabouts.configured: None, self.peer_address: None})

    def counters_dict(self) -> dict[str, int]:
        """Counters by name."""
        c = self.counters
        return {name: getattr(c, name) for name in ChannelCounters.__slots__}

    def set_wall_clock(self, unix_ns: int, now_ns: int) -> None:
        """The wall clock may have been stepped."""
        self._unix_minus_monotonic_ns = unix_ns - now_ns

    @property
    def notices(self) -> deque[Notice]:
        """What people should know and have not been told."""
        return self._notices.waiting

    # Sending.

    def seal(self, datagram: bytes, number: int) -> bytes:
        """Protect a datagram of the endpoint's. number: its packet number in full."""
        assert self._current is not None, "a channel that is not ready seals nothing"
        return self._current.seal(datagram, number)

    def seal_control(self, payload: bytes) -> bytes:
        """Protect something for the peer's channel."""
        assert self._current is not None, "a channel that is not ready seals nothing"
        return self._current.seal_control(payload)

    def seal_carousel(self, body: bytes) -> bytes | None:
        """Protect what our carousel sends, under the session in use; None if there is none yet."""
        return None if self._current is None else self._current.seal_carousel(body, self._side)

    def open_carousel(self, data: bytes) -> bytes | None:
        """What the peer's carousel has sent; None for all else, which changes nothing but a counter.

        It tells nothing of where the peer is, nor that it hears us: that is for the two-way link.
        """
        try:
            session = self._by_id.get(decode_clear(data)[0])
            if session is None:
                self.counters.strangers += 1
                return None
            body = session.carousel.open(data, other_side(self._side))
        except DecodeError:
            self.counters.forged += 1
            return None
        self.counters.replayed += body is None
        return body

    def copy_to(self, datagram_bytes: int) -> Address | None:
        """Where the peer seems to have moved, if a copy of what leaves now may go there too."""
        return self._whereabouts.copy_to(datagram_bytes)

    def next_handshake(self, now_ns: int) -> tuple[bytes, Address] | None:
        """A datagram of the channel's own that has to leave now, and where to; None if there is none."""
        if now_ns >= self._look_at_ns:
            self._look_at_ns = self._initiate_when_ns()
            if now_ns >= self._look_at_ns:
                self._initiate(now_ns)
                self._look_at_ns = self._initiate_when_ns()
        return self._to_send.popleft() if self._to_send else None

    def wakeup_at_ns(self) -> int:
        """When there may be something to do, if nothing happens before."""
        return self._look_at_ns

    def _initiate_when_ns(self) -> int:
        session = self._current
        if session is None:
            return self._initiate_at_ns
        patience_ns = _REKEY_PATIENCE_NS if session.answered_to else 0
        due_ns = session.made_ns + REKEY_AFTER_NS + patience_ns
        if session.sealed >= _REKEY_AFTER_SEALED or session.forged >= MAX_FORGED:
            due_ns = session.made_ns
        if self.last_heard_ns is not None:
            due_ns = min(due_ns, self.last_heard_ns + SILENCE_NS)
        return max(due_ns, self._initiate_at_ns)

    def _initiate(self, now_ns: int) -> None:
        session_id = self._new_session_id()
        initiator = Initiator(self._own_key.secret, prologue(self._side), self._random(KEY_BYTES))
        message = initiator.write(encode_hello(self._hello(session_id, now_ns)))
        if len(self._asked) >= _MAX_ASKED:
            self._asked.pop(next(iter(self._asked)))
        # It may have moved, or we may have believed that it has.
        where = self._whereabouts.configured if self._attempts % 2 else self.peer_address
        self._asked[session_id] = _Asked(initiator, now_ns, where)
        key = self._own_key
        self._to_send.append((encode_initiation(key, self._initiations.check_of(key), message), where))
        self._attempts += 1
        if self._sessions:
            silence_ns = 0 if self.last_heard_ns is None else now_ns - self.last_heard_ns
            retry_ns = min(max(_SILENT_RETRY_NS, silence_ns // _SILENT_SLOWING), _LONGEST_RETRY_NS)
        else:
            retry_ns = _FIRST_RETRY_NS if self._attempts <= _FIRST_RETRIES else _RETRY_NS
        self._initiate_at_ns = now_ns + retry_ns
        if not self._sessions:
            self._notices.without_answer(self._whereabouts.configured, self._own_key.name, now_ns)

    def _hello(self, session_id: int, now_ns: int) -> Hello:
        return Hello(session_id, now_ns + self._unix_minus_monotonic_ns, self._identity)

    def _new_session_id(self) -> int:
        while True:
            session_id = int.from_bytes(self._random(2), "little")
            if session_id not in self._by_id and session_id not in self._asked:
                self.numbers_drawn += 1
                return session_id

    # Receiving.

    def receive(self, data: bytes, source: Address, now_ns: int) -> bytes | Control | None:
        """A plain datagram of the peer's, or something from its channel; None for all else."""
        kind = data[0] & 0x0F if data else 0
        try:
            if kind in (PROTECTED, CONTROL) and len(data) >= CLEAR_BYTES + TAG_BYTES:
                return self._open(data, kind, source, now_ns)
            if kind == INITIATION and len(data) == INITIATION_BYTES:
                self._on_initiation(data, source, now_ns)
            elif kind == ANSWER and len(data) == ANSWER_BYTES:
                self._on_answer(data, source, now_ns)
            else:
                self.counters.strangers += 1
        except DecodeError:
            self.counters.forged += 1
        return None

    def _open(self, data: bytes, kind: int, source: Address, now_ns: int) -> bytes | Control | None:
        session = self._by_id.get(int.from_bytes(data[1:3], "little"))
        if session is None:
            self.counters.strangers += 1
            return None
        proven = session.proven
        opened = self._unseal(session, data, source, now_ns)
        if opened is None:
            return None
        body, newest = opened
        if self._answered.pop(session.own_id, None) is not None:
            self._establish(session, session.made_ns, now_ns)
        elif not proven:
            self._choose_session()
        if self._heard(session, now_ns):
            if not proven and source == session.answered_to:
                self._move(source, now_ns)  # it has our answer, and speaks from where we sent it
            elif newest:
                self._follow(source, len(data), now_ns)
            if kind == CONTROL and body[:1] in (CHALLENGE, ANSWERED):
                self._on_trial(body, source, now_ns)
                return None
        return Control(body) if kind == CONTROL else body

    def _unseal(
        self, session: Session, data: bytes, source: Address, now_ns: int
    ) -> tuple[bytes, bool] | None:
        """As Session.open; None, and counted, for what is forged too."""
        try:
            opened = session.open(data, now_ns)
            self.counters.replayed += opened is None
        except DecodeError:
            opened = None
            self.counters.forged += 1
        self.unwanted.sealed += opened is None and source not in self.peers
        return opened

    def _heard(self, session: Session, now_ns: int) -> bool:
        """The peer has sealed something; whether it is a sign of its present life."""
        current = self._current
        if current is None or session.hello.identity != current.hello.identity:
            return False
        self.last_heard_ns = now_ns
        if len(self._sessions) > 1:
            idle = [s for s in self._sessions if s is not current and now_ns - s.used_ns > _OVERLAP_NS]
            self._forget(idle)
        return True

    def _follow(self, source: Address, datagram_bytes: int, now_ns: int) -> None:
        """Nothing newer than this datagram has come, and it came from there."""
        token = self._whereabouts.on_heard(source, datagram_bytes, now_ns)
        if token is not None and self.ready:
            self._to_send.append((self.seal_control(CHALLENGE + token), source))

    def _on_trial(self, body: bytes, source: Address, now_ns: int) -> None:
        """The peer's channel asks whether we are where we seem to be, or answers the same."""
        old = self.peer_address
        if len(body) != CHALLENGE_BYTES:
            raise DecodeError(f"a challenge of {len(body)} bytes: expected {CHALLENGE_BYTES}")
        if body[:1] == CHALLENGE:
            if self.ready:
                self._to_send.append((self.seal_control(ANSWERED + body[1:]), source))
        elif self._whereabouts.on_answer(source, body[1:]):
            self._notices.moved(old, source, now_ns)

    def _move(self, source: Address, now_ns: int) -> None:
        old = self.peer_address
        if self._whereabouts.move(source):
            self._notices.moved(old, source, now_ns)

    def _choose_session(self) -> None:
        """Seal with the newest session under which the peer has sealed something too.

        One that it has not may be lost on it; but where there is no other with the peer's present life, it
        has at least answered.
        """
        newest = self._sessions[-1]
        alive = [s for s in self._sessions if s.hello.identity == newest.hello.identity]
        self._current = next((s for s in reversed(alive) if s.proven), newest)

    def _forget(self, sessions: list[Session]) -> None:
        for session in sessions:
            self._sessions.remove(session)
            del self._by_id[session.own_id]

    def _on_initiation(self, data: bytes, source: Address, now_ns: int) -> None:
        found = self._initiations.read(data, source, now_ns, of_peer=source in self.peers)
        if found is not None and self._has_just_answered(found[1], source, now_ns):
            self._initiations.refused += 1
        elif found is not None:
            responder, hello, key = found
            self._answer(responder, hello, key.name, source, now_ns)
        self.counters.failed_handshakes = self._initiations.failed
        self.counters.refused_handshakes = self._initiations.refused

    def _has_just_answered(self, hello: Hello, source: Address, now_ns: int) -> bool:
        """Whether this is one more of what a link has held, from a peer that has a session with us."""
        if self._current is None or self._current.hello.identity != hello.identity:
            return False
        return any(
            session.answered_to == source
            and session.hello.identity == hello.identity
            and now_ns - session.made_ns < _ONE_ANSWER_NS
            for session in (*self._answered.values(), *self._sessions)
        )

    def _answer(
        self, responder: Responder, hello: Hello, key_name: str, source: Address, now_ns: int
    ) -> None:
        session_id = self._new_session_id()
        payload = encode_hello(self._hello(session_id, now_ns))
        message, keys = responder.write(payload, self._random(KEY_BYTES))
        for late in [i for i, s in self._answered.items() if now_ns - s.made_ns > _UNDER_WAY_NS]:
            del self._answered[late], self._by_id[late]
        if len(self._answered) >= _MAX_ANSWERED:
            oldest = next(iter(self._answered))
            del self._answered[oldest], self._by_id[oldest]
        session = Session(session_id, hello, keys, key_name, answered_to=source, now_ns=now_ns)
        self._answered[session_id] = self._by_id[session_id] = session
        self._to_send.append((bytes([ANSWER]) + hello.session_id.to_bytes(2, "little") + message, source))

    def _on_answer(self, data: bytes, source: Address, now_ns: int) -> None:
        session_id = int.from_bytes(data[1:3], "little")
        asked = self._asked.get(session_id)
        if asked is None:
            self.counters.strangers += 1
            return
        payload, keys = asked.initiator.read(data[3:])
        del self._asked[session_id]
        session = Session(session_id, decode_hello(payload), keys, self._own_key.name, now_ns=now_ns)
        self._by_id[session_id] = session
        self._establish(session, asked.asked_ns, now_ns)
        if self._heard(session, now_ns):
            if source == asked.where:
                self._move(source, now_ns)
            else:
                self._follow(source, len(data), now_ns)
        self._to_send.append((session.seal_control(b""), source))  # by which it knows us too

    def _establish(self, session: Session, told_from_ns: int, now_ns: int) -> None:
        """Both sides have proved that they hold the key, and that they are there now."""
        self._sessions.append(session)
        self._sessions.sort(key=lambda each: each.made_ns)  # a late proof makes no older session the newest
        self._choose_session()
        if len(self._sessions) > _MAX_SESSIONS:
            others = [s for s in self._sessions if s is not self._current and s is not session]
            self._forget([min(others, key=lambda s: s.used_ns)])
        if session is self._sessions[-1]:
            self._asked.clear()
            self._attempts = 0
            self._initiate_at_ns = now_ns + _FIRST_RETRY_NS
        self._look_at_ns = now_ns
        self.counters.handshakes += 1
        if self.counters.handshakes == 1:
            self._notices.secured(session.key_name, now_ns)
        unix_ns = now_ns + self._unix_minus_monotonic_ns
        self._notices.compare_clocks(session.hello.unix_ns, unix_ns, told_from_ns, now_ns)

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
    other_side,
    prologue,
)
from shaper.link_key import ID_BYTES, LinkKey
from shaper.noise import KEY_BYTES, Initiator, Responder
from shaper.notices import Notice, NoticeKind
from shaper.rate_limit import RateLimit
from shaper.session import CLEAR_BYTES, CONTROL, MAX_FORGED, MAX_SEALED, PROTECTED, TAG_BYTES, Session

Address = tuple[str, int]

_NS_PER_S = 1_000_000_000
REKEY_AFTER_NS = 600 * _NS_PER_S
_REKEY_PATIENCE_NS = (
    60 * _NS_PER_S
)  # by which the side that did not start the session lets the other go first
_REKEY_AFTER_SEALED = MAX_SEALED // 2
SILENCE_NS = 3 * _NS_PER_S  # without anything from the peer: it may have lost the session
_FIRST_RETRIES, _FIRST_RETRY_NS = 120, _NS_PER_S // 2
_RETRY_NS, _SILENT_RETRY_NS = _NS_PER_S, 2 * _NS_PER_S
_MAX_ANSWERED = 8  # handshakes that wait for the peer's proof
_MAX_ASKED = 16  # and for its answer: of round trips up to eight seconds
_UNDER_WAY_NS = 60 * _NS_PER_S
_MAX_SESSIONS = 3  # in use, and before it
_OVERLAP_NS = 60 * _NS_PER_S  # for which former keys still open what is late
_REMEMBERED_INITIATIONS = 512
_NO_ANSWER_NS, _NO_ANSWER_AGAIN_NS = 5 * _NS_PER_S, 60 * _NS_PER_S
_NOTICE_AGAIN_NS = 10 * _NS_PER_S
_CLOCK_TOLERANCE_NS = 2 * _NS_PER_S


@dataclass(slots=True)
class ChannelCounters:
    """What came that was not the peer's, and what was done about it."""

    handshakes: int = 0
    strangers: int = 0  # no datagram of any session or handshake
    forged: int = 0  # a session's number, but not its key
    replayed: int = 0
    failed_handshakes: int = 0  # another key, or none
    refused_handshakes: int = 0  # more than are answered in a second


@dataclass(frozen=True, slots=True)
class Control:
    """What the peer's channel has to say to ours."""

    payload: bytes


@dataclass(slots=True)
class _Asked:
    """A handshake that we have started."""

    initiator: Initiator
    asked_ns: int


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
        self.peer_address = peer
        self.last_heard_ns: int | None = None
        self.notices: deque[Notice] = deque(maxlen=64)
        self._side = side
        self._keys = {key.id: key for key in keys}
        self._own_key = keys[0]
        self._identity = identity
        self._configured_peer = peer
        self._random = random_bytes
        self._unix_minus_monotonic_ns = unix_ns - now_ns
        self._started_ns = now_ns
        self._asked: dict[int, _Asked] = {}  # by our session number
        self._answered: dict[int, Session] = {}  # until the peer proves that it has our answer
        self._sessions: list[Session] = []  # oldest first
        self._current: Session | None = None  # the one to seal with
        self._by_id: dict[int, Session] = {}
        self._seen_ephemerals: dict[bytes, None] = {}
        self._to_send: deque[tuple[bytes, Address]] = deque(maxlen=_MAX_ANSWERED)
        self._attempts = 0
        self._initiate_at_ns = now_ns
        self._look_at_ns = now_ns  # not before this; whatever is heard only puts it off
        self._complain_at_ns = now_ns + _NO_ANSWER_NS
        self._noticed: dict[NoticeKind, int] = {}
        # One limit for the peer's address, one for everybody else: neither can use up the other's.
        self._read_limits = (RateLimit(200, 50, now_ns), RateLimit(200, 50, now_ns))
        self._answer_limits = (RateLimit(10, 10, now_ns), RateLimit(5, 10, now_ns))

    # What drivers and the endpoint look at.

    @property
    def ready(self) -> bool:
        """Whether datagrams can be sealed."""
        return self._current is not None

    @property
    def peer(self) -> Identity | None:
        """What the peer told of itself in the session in use."""
        return self._current.hello.identity if self._current is not None else None

    def session_ids(self) -> list[int]:
        """Numbers under which datagrams may come: for a filter in front of the socket."""
        return [*self._by_id, *self._asked]

    def counters_dict(self) -> dict[str, int]:
        """Counters by name."""
        c = self.counters
        return {name: getattr(c, name) for name in ChannelCounters.__slots__}

    def set_wall_clock(self, unix_ns: int, now_ns: int) -> None:
        """The wall clock may have been stepped."""
        self._unix_minus_monotonic_ns = unix_ns - now_ns

    # Sending.

    def seal(self, datagram: bytes, number: int) -> bytes:
        """Protect a datagram of the endpoint's. number: its packet number in full."""
        assert self._current is not None, "a channel that is not ready seals nothing"
        return self._current.seal(datagram, number)

    def seal_control(self, payload: bytes) -> bytes:
        """Protect something for the peer's channel."""
        assert self._current is not None, "a channel that is not ready seals nothing"
        return self._current.seal_control(payload)

    def next_handshake(self, now_ns: int) -> tuple[bytes, Address] | None:
        """A handshake datagram that has to leave now, and where to; None if there is none."""
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
        wait_ns = REKEY_AFTER_NS if session.initiated else REKEY_AFTER_NS + _REKEY_PATIENCE_NS
        due_ns = session.made_ns + wait_ns
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
        self._asked[session_id] = _Asked(initiator, now_ns)
        # It may have moved, or we may have believed that it has.
        where = self._configured_peer if self._attempts % 2 else self.peer_address
        self._to_send.append((bytes([INITIATION]) + self._own_key.id + message, where))
        self._attempts += 1
        if self._sessions:
            retry_ns = _SILENT_RETRY_NS
        else:
            retry_ns = _FIRST_RETRY_NS if self._attempts <= _FIRST_RETRIES else _RETRY_NS
        self._initiate_at_ns = now_ns + retry_ns
        self._complain_without_answer(now_ns)

    def _hello(self, session_id: int, now_ns: int) -> Hello:
        return Hello(session_id, now_ns + self._unix_minus_monotonic_ns, self._identity)

    def _new_session_id(self) -> int:
        while True:
            session_id = int.from_bytes(self._random(2), "little")
            if session_id not in self._by_id and session_id not in self._asked:
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
        opened = session.open(data, now_ns)
        if opened is None:
            self.counters.replayed += 1
            return None
        body, newest = opened
        if self._answered.pop(session.own_id, None) is not None:
            self._establish(session, session.made_ns, now_ns)
        elif not proven:
            self._choose_session()
        self._heard(session, source if newest else None, now_ns)
        return Control(body) if kind == CONTROL else body

    def _heard(self, session: Session, source: Address | None, now_ns: int) -> None:
        """The peer has sealed something. source: where it is, if nothing newer has told."""
        current = self._current
        if (
            current is None or session.hello.identity != current.hello.identity
        ):  # a former life's: no sign of the present one
            return
        self.last_heard_ns = now_ns
        if source is not None and source != self.peer_address:
            old, self.peer_address = self.peer_address, source
            text = f"the other side is at {_show(source)} now (before: {_show(old)})"
            self._notice(NoticeKind.PEER_MOVED, text, now_ns)
        if len(self._sessions) > 1:
            idle = [s for s in self._sessions if s is not current and now_ns - s.used_ns > _OVERLAP_NS]
            self._forget(idle)

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
        known = 0 if source in (self.peer_address, self._configured_peer) else 1
        key = self._keys.get(data[1 : 1 + ID_BYTES])
        if key is None:
            self.counters.failed_handshakes += 1
            return self._complain_of_key_id(data[1 : 1 + ID_BYTES], source, now_ns)
        message = data[1 + ID_BYTES :]
        ephemeral = message[:KEY_BYTES]
        if ephemeral in self._seen_ephemerals:
            self.counters.replayed += 1
            return
        if not self._read_limits[known].allows(now_ns):
            self.counters.refused_handshakes += 1
            return
        responder = Responder(key.secret, prologue(other_side(self._side)))
        try:
            hello = decode_hello(responder.read(message))
        except DecodeError:
            self.counters.failed_handshakes += 1
            return self._complain_of_key(key, source, now_ns)
        if not self._answer_limits[known].allows(now_ns):
            self.counters.refused_handshakes += 1
            return
        self._remember_ephemeral(ephemeral)
        self._answer(responder, hello, key.name, source, now_ns)

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
        session = Session(session_id, hello, keys, key_name, initiated=False, now_ns=now_ns)
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
        session = Session(
            session_id, decode_hello(payload), keys, self._own_key.name, initiated=True, now_ns=now_ns
        )
        self._by_id[session_id] = session
        self._establish(session, asked.asked_ns, now_ns)
        self._heard(session, source, now_ns)
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
        first = self.counters.handshakes == 1
        if first:
            self._notice(NoticeKind.SECURED, f"the link is secured with key {session.key_name}", now_ns)
        self._compare_clocks(session.hello, told_from_ns, now_ns)

    def _remember_ephemeral(self, ephemeral: bytes) -> None:
        if len(self._seen_ephemerals) >= _REMEMBERED_INITIATIONS:
            del self._seen_ephemerals[next(iter(self._seen_ephemerals))]
        self._seen_ephemerals[ephemeral] = None

    # What a person should know.

    def _compare_clocks(self, hello: Hello, from_ns: int, now_ns: int) -> None:
        """The peer read its clock at some time between the two instants, or one transit before."""
        ours_ns = now_ns + self._unix_minus_monotonic_ns - (now_ns - from_ns) // 2
        ahead_ns = hello.unix_ns - ours_ns
        if abs(ahead_ns) <= _CLOCK_TOLERANCE_NS + (now_ns - from_ns):
            return
        how = "ahead of" if ahead_ns > 0 else "behind"
        self._notice(
            NoticeKind.CLOCK_DIFFERS,
            f"the other side's wall clock is {_duration(abs(ahead_ns))} {how} ours: ages stay right, but "
            "the two sides' stamps and recordings disagree; set both hosts' clocks (chrony, ntpd, `date`)",
            now_ns,
        )

    def _complain_without_answer(self, now_ns: int) -> None:
        if self._sessions or now_ns < self._complain_at_ns:
            return
        self._complain_at_ns = now_ns + _NO_ANSWER_AGAIN_NS
        self._notice(
            NoticeKind.NO_ANSWER,
            f"no answer from {_show(self._configured_peer)} for {_duration(now_ns - self._started_ns)}: is "
            f"the other side running, do datagrams pass both ways, and is key {self._own_key.name} among its "
            "link.keys? Its log names the key if it gets ours but does not know it",
            now_ns,
        )

    def _complain_of_key_id(self, key_id: bytes, source: Address, now_ns: int) -> None:
        ours = ", ".join(key.name for key in self._keys.values())
        self._notice(
            NoticeKind.UNKNOWN_KEY,
            f"{_show(source)} uses link key {key_id.hex()}, which is not among ours ({ours}): if that is the "
            "other side, copy the same key file to both sides and name it in link.keys",
            now_ns,
        )

    def _complain_of_key(self, key: LinkKey, source: Address, now_ns: int) -> None:
        self._notice(
            NoticeKind.WRONG_KEY,
            f"{_show(source)} names link key {key.name} but does not hold it, or both daemons are of the "
            f"{self._side}'s side: compare the key files and link.side of both sides",
            now_ns,
        )

    def _notice(self, kind: NoticeKind, text: str, now_ns: int) -> None:
        """Say something, but the same kind of thing only every ten seconds."""
        last_ns = self._noticed.get(kind)
        if last_ns is None or now_ns - last_ns >= _NOTICE_AGAIN_NS:
            self._noticed[kind] = now_ns
            self.notices.append(Notice(kind, text))


def _show(address: Address) -> str:
    return f"{address[0]}:{address[1]}"


def _duration(duration_ns: int) -> str:
    seconds = duration_ns // _NS_PER_S
    if seconds < 120:
        return f"{seconds} s"
    minutes = seconds // 60
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"

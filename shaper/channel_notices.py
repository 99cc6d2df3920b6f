"""What a channel tells people: each a sentence that says what to do, and none more often than is useful."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from shaper.handshake import Side
from shaper.link_key import LinkKey
from shaper.notices import Notice, NoticeKind
from shaper.whereabouts import Address

_NS_PER_S = 1_000_000_000
_NO_ANSWER_NS, _NO_ANSWER_AGAIN_NS = 5 * _NS_PER_S, 60 * _NS_PER_S
_AGAIN_NS = 10 * _NS_PER_S  # the same kind of thing
_CLOCK_TOLERANCE_NS = 2 * _NS_PER_S


class ChannelNotices:
    """The sentences that have not been fetched yet, and when which kind was last said."""

    def __init__(self, now_ns: int) -> None:
        self.waiting: deque[Notice] = deque(maxlen=64)
        self._started_ns = now_ns
        self._complain_at_ns = now_ns + _NO_ANSWER_NS
        self._said_ns: dict[NoticeKind, int] = {}

    def secured(self, key_name: str, now_ns: int) -> None:
        """The first handshake is complete."""
        self._say(NoticeKind.SECURED, f"the link is secured with key {key_name}", now_ns)

    def moved(self, old: Address, new: Address, now_ns: int) -> None:
        """The peer has another address."""
        text = f"the other side is at {_show(new)} now (before: {_show(old)})"
        self._say(NoticeKind.PEER_MOVED, text, now_ns)

    def compare_clocks(self, theirs_unix_ns: int, ours_unix_ns: int, from_ns: int, now_ns: int) -> None:
        """The peer read its clock at some time between the two instants, or one transit before.

        ours_unix_ns: our wall clock now.
        """
        ahead_ns = theirs_unix_ns - (ours_unix_ns - (now_ns - from_ns) // 2)
        if abs(ahead_ns) <= _CLOCK_TOLERANCE_NS + (now_ns - from_ns):
            return
        how = "ahead of" if ahead_ns > 0 else "behind"
        self._say(
            NoticeKind.CLOCK_DIFFERS,
            f"the other side's wall clock is {_duration(abs(ahead_ns))} {how} ours: ages stay right, but "
            "the two sides' stamps and recordings disagree; set both hosts' clocks (chrony, ntpd, `date`)",
            now_ns,
        )

    def without_answer(self, asked: Address, key_name: str, now_ns: int) -> None:
        """A handshake is started although none has ever been completed."""
        if now_ns < self._complain_at_ns:
            return
        self._complain_at_ns = now_ns + _NO_ANSWER_AGAIN_NS
        self._say(
            NoticeKind.NO_ANSWER,
            f"no answer from {_show(asked)} for {_duration(now_ns - self._started_ns)}: is "
            f"the other side running, do datagrams pass both ways, and is key {key_name} among its "
            "link.keys? Its log names the key if it gets ours but does not know it",
            now_ns,
        )

    def unknown_key(self, key_id: bytes, ours: Sequence[str], source: Address, now_ns: int) -> None:
        """Somebody starts a handshake with a key that this side does not have."""
        self._say(
            NoticeKind.UNKNOWN_KEY,
            f"{_show(source)} uses link key {key_id.hex()}, which is not among ours ({', '.join(ours)}): if "
            "that is the other side, copy the same key file to both sides and name it in link.keys",
            now_ns,
        )

    def wrong_key(self, key: LinkKey, side: Side, source: Address, now_ns: int) -> None:
        """Somebody names a key that he does not hold, or starts from the side that is ours."""
        self._say(
            NoticeKind.WRONG_KEY,
            f"{_show(source)} names link key {key.name} but does not hold it, or both daemons are of the "
            f"{side}'s side: compare the key files and link.side of both sides",
            now_ns,
        )

    def _say(self, kind: NoticeKind, text: str, now_ns: int) -> None:
        last_ns = self._said_ns.get(kind)
        if last_ns is None or now_ns - last_ns >= _AGAIN_NS:
            self._said_ns[kind] = now_ns
            self.waiting.append(Notice(kind, text))


def _show(address: Address) -> str:
    return f"{address[0]}:{address[1]}"


def _duration(duration_ns: int) -> str:
    seconds = duration_ns // _NS_PER_S
    if seconds < 120:
        return f"{seconds} s"
    minutes = seconds // 60
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"

"""Getting the peer's topic table across, in parts that are asked for one by one, and comparing it.

ask     0x03 · hash 8 · index 1                    for a part of the table with this hash
part    0x04 · hash 8 · index 1 · parts 1 · bytes  at most 400 of them
"""

from __future__ import annotations

from collections import deque

from shaper.agreement import (
    MAX_PACKED_BYTES,
    Difference,
    TopicTable,
    differences,
    table_hash,
    unpack_table,
)
from shaper.errors import DecodeError
from shaper.handshake import TABLE_HASH_BYTES
from shaper.notices import Notice, NoticeKind

ASK, PART = 0x03, 0x04
PART_BYTES = 400
_RETRY_NS = 2_000_000_000
_ASK_BYTES = 1 + TABLE_HASH_BYTES + 1
_MAX_NAMED = 5  # topics in one sentence


class TableExchange:
    """Both directions of it: answers for our table, questions for the peer's.

    refused_here, refused_there: key expressions of the peer's topics, and of ours, that are not meant
    alike; empty until the tables are known.
    """

    def __init__(self, table: TopicTable) -> None:
        self.table = table
        self.notices: deque[Notice] = deque(maxlen=8)
        self.refused_here: tuple[str, ...] = ()
        self.refused_there: tuple[str, ...] = ()
        self._packed = table.packed()
        self.hash = table_hash(self._packed)
        self._wanted = b""  # hash of the peer's table
        self._parts: list[bytes] = []
        self._count = 1
        self._known = b""
        self._ask_at_ns: int | None = None

    def meet(self, peer_hash: bytes, now_ns: int) -> None:
        """A peer has been met that has a table with this hash; all zero if it has none to show."""
        if peer_hash in (self._known, bytes(TABLE_HASH_BYTES)):
            self._ask_at_ns = None
            return
        if peer_hash != self._wanted:
            self._wanted, self._parts, self._count = peer_hash, [], 1
        self._ask_at_ns = now_ns

    def next_question(self, now_ns: int) -> bytes | None:
        """The question that should leave now, if any."""
        if self._ask_at_ns is None or now_ns < self._ask_at_ns:
            return None
        self._ask_at_ns = now_ns + _RETRY_NS
        return bytes([ASK]) + self._wanted + bytes([len(self._parts)])

    def wakeup_at_ns(self) -> int | None:
        """When to ask (again)."""
        return self._ask_at_ns

    def answer(self, question: bytes) -> bytes:
        """The part that a peer asks for. Raises DecodeError."""
        if len(question) != _ASK_BYTES or question[1:-1] != self.hash:
            raise DecodeError("a question for a topic table that is not ours")
        count = -(-len(self._packed) // PART_BYTES)
        index = question[-1]
        if index >= count:
            raise DecodeError(f"a question for part {index} of {count}")
        part = self._packed[index * PART_BYTES : (index + 1) * PART_BYTES]
        return bytes([PART]) + self.hash + bytes([index, count]) + part

    def on_part(self, payload: bytes, now_ns: int) -> bool:
        """Take a part; whether the peer's table is complete and compared now. Raises DecodeError."""
        head = 1 + TABLE_HASH_BYTES
        if len(payload) <= head + 2 or self._ask_at_ns is None or payload[1:head] != self._wanted:
            return False
        index, count, part = payload[head], payload[head + 1], payload[head + 2 :]
        if index != len(self._parts) or not index < count <= MAX_PACKED_BYTES // PART_BYTES:
            return False
        self._count = count
        self._parts.append(part)
        self._ask_at_ns = now_ns
        if len(self._parts) < count:
            return False
        packed, self._parts, self._ask_at_ns = b"".join(self._parts), [], None
        if table_hash(packed) != self._wanted:
            raise DecodeError("a topic table does not have the hash that the handshake told")
        self._known = self._wanted
        self._compare(unpack_table(packed))
        return True

    def _compare(self, theirs: TopicTable) -> None:
        here, there = differences(theirs, self.table), differences(self.table, theirs)
        self.refused_here = tuple(d.topic for d in here)
        self.refused_there = tuple(d.topic for d in there)
        if not here and not there:
            text = "both sides mean all topics alike"
            self.notices.append(Notice(NoticeKind.TABLE_AGREES, text))
            return
        for found, ours in ((there, True), (here, False)):
            if found:
                self.notices.append(Notice(NoticeKind.TABLE_DIFFERS, _sentence(found, ours=ours)))


def _sentence(found: list[Difference], *, ours: bool) -> str:
    whose = "our" if ours else "the other side's"
    first = found[0].text(ours=ours)
    others = [d.topic for d in found[1 : 1 + _MAX_NAMED]]
    more = len(found) - 1 - len(others)
    rest = (
        f"; the same goes for {', '.join(others)}" + (f" and {more} more" if more else "") if others else ""
    )
    return (
        f"{len(found)} of {whose} topics are refused, since the two sides differ on them: {first}{rest}; "
        "give both sides the same [[topics]] and [encodings], and accept what the other one sends"
    )

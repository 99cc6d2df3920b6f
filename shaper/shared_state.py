"""A state that both sides share (`keep = "changes"`): nothing crosses while nothing changes.

The sender knows what the receiver has acknowledged and sends the entries that differ from it, one
message under way at a time. If that is lost it is not repeated: the difference is taken anew, and holds
what has changed since. The receiver takes an entry from the newest message that names it. So both
converge after loss, reordering or a restart of either. Idea: Mosh's state synchronisation (Winstein and
Balakrishnan, USENIX ATC 2012).
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

from messages.keyed_entries import REST, Entry, NotProtobufError, split_entries
from shaper.compression import pack
from shaper.errors import DecodeError
from shaper.frames import Outcome
from shaper.path import Content
from shaper.queues import Departure, Payload, Piece, TopicQueue
from shaper.traffic_class import Compression, Entries, TopicRule
from shaper.varint import append_varint, read_varint

_HASH = struct.Struct("<I")
_GONE = b""


@dataclass(frozen=True, slots=True)
class _SentState:
    queue: ChangesQueue
    number: int

    def on_arrived(self) -> None:
        """Nothing: the receipt says that the whole message is there."""

    def on_lost(self) -> None:
        self.queue.on_lost(self.number)


class ChangesQueue(TopicQueue):
    """Holds the newest state of a key, and what the peer has of it.

    In the ledger an offer that changes nothing counts as decimated.
    """

    __slots__ = (
        "_acknowledged",
        "_capture_ns",
        "_carried",
        "_compared",
        "_encoding",
        "_pending",
        "_raw",
        "_tag",
        "_under_way",
    )

    def __init__(self, key: str, rule: TopicRule, wake: Callable[[TopicQueue], None]) -> None:
        super().__init__(key, rule, wake)
        self._raw: dict[int, bytes] = {}
        self._compared: dict[int, bytes] = {}
        self._acknowledged: dict[int, bytes] = {}  # as compared
        self._under_way: tuple[int, dict[int, bytes]] | None = None  # message number, what it brings
        self._pending = self._carried = 0  # offers that wait, and that are under way: 0 or 1 each
        self._encoding, self._capture_ns, self._tag = "", 0, 0

    def offer(self, payload: Payload, encoding: str, capture_ns: int, now_ns: int, tag: int = 0) -> bool:
        self.ledger.offered += 1
        if not self.due(now_ns):
            self.ledger.decimated += 1
            return False
        entries = _split(bytes(payload), self.rule.entries)
        compared = {name: entry.compared for name, entry in entries.items()}
        if compared == self._compared:
            self.ledger.decimated += 1
            return False
        self._raw = {name: entry.raw for name, entry in entries.items()}
        self._compared = compared
        self._encoding, self._capture_ns, self._tag = encoding, capture_ns, tag
        self.ledger.superseded += self._pending
        self._pending = 1
        return not self.empty

    def next_piece(self, now_ns: int) -> Piece | None:
        if self.departing is not None and not self.departing.begun:
            self._return_pending()
        departure = self.departing or self.depart(now_ns)
        return None if departure is None else Piece(departure, departure.offset, departure.remaining_bytes)

    def depart(self, now_ns: int) -> Departure | None:
        if self._under_way is not None:
            return None
        names = self._differing()
        if not names:
            self.ledger.superseded += self._pending  # changed back before it could leave
            self._pending = 0
            return None
        self._under_way = self.next_number, {name: self._compared.get(name, _GONE) for name in names}
        self._carried, self._pending = self._pending, 0
        data = encode_entries(
            {name: self._raw.get(name, _GONE) for name in names}, whole=not self._acknowledged
        )
        data, compressed = pack(data, Compression.ZSTD)
        self.departing = Departure(
            data, self._encoding, self._capture_ns, self.next_number, compressed, self._tag
        )
        return self.departing

    def sent(self, piece: Piece, count: int, loss_ratio: float = 0.0) -> Content | None:
        super().sent(piece, count, loss_ratio)
        return _SentState(self, piece.departure.number)

    def departed(self) -> None:
        self.departing = None

    def on_lost(self, number: int) -> None:
        """A message did not arrive whole: the difference is taken anew."""
        if self._under_way is not None and self._under_way[0] == number:
            self._return_pending()
            self.wake(self)

    def on_outcome(self, number_low_bits: int, outcome: Outcome) -> None:
        """The peer has taken a message."""
        if self._under_way is None or self._under_way[0] & 0xFFFF != number_low_bits:
            return
        for name, compared in self._under_way[1].items():
            if compared == _GONE and name not in self._compared:
                self._acknowledged.pop(name, None)
            else:
                self._acknowledged[name] = compared
        self.ledger.sent += self._carried
        self._carried, self._under_way, self.departing = 0, None, None
        if not self.empty:
            self.wake(self)

    def on_peer_restarted(self) -> None:
        self._acknowledged.clear()
        self._return_pending()
        if not self.empty:
            self.wake(self)

    @property
    def awaits_outcome(self) -> bool:
        """Whether a message is under way."""
        return self._under_way is not None

    @property
    def empty(self) -> bool:
        if self.departing is not None:
            return False
        return self._under_way is not None or (not self._pending and self._compared == self._acknowledged)

    def _return_pending(self) -> None:
        """What was under way is to be sent after all, unless something newer waits already."""
        if self.departing is not None and self.departing.begun:
            self.next_number = max(self.next_number, self.departing.number + 1)
        self.departing = self._under_way = None
        self.ledger.superseded += self._carried and self._pending
        self._pending = max(self._pending, self._carried)
        self._carried = 0

    def _differing(self) -> list[int]:
        mine, theirs = self._compared, self._acknowledged
        changed = [name for name, compared in mine.items() if theirs.get(name) != compared]
        return changed + [name for name in theirs if name not in mine]


def encode_entries(entries: dict[int, bytes], *, whole: bool) -> bytes:
    """Entries by hash; an empty one is gone (the entry REST may be empty and there).

    whole: there are no others; what the receiver has of a state that we know nothing of is gone.
    """
    out = bytearray([whole])
    for name, raw in entries.items():
        out += _HASH.pack(name)
        append_varint(out, len(raw) + 1 if raw or name == REST else 0)
        out += raw
    return bytes(out)


def decode_entries(data: bytes) -> tuple[dict[int, bytes | None], bool]:
    """Undo `encode_entries`: entries, None for one that is gone, and `whole`. Raises DecodeError."""
    entries: dict[int, bytes | None] = {}
    if not data or data[0] > 1:
        raise DecodeError("a state does not start with whether it is whole")
    at = 1
    while at < len(data):
        if at + _HASH.size > len(data):
            raise DecodeError(f"a state's entry at byte {at} has no hash")
        (name,) = _HASH.unpack_from(data, at)
        size, at = read_varint(data, at + _HASH.size)
        if size == 0:
            entries[name] = None
            continue
        if at + size - 1 > len(data):
            raise DecodeError(f"a state's entry of {size - 1} bytes at byte {at} runs past the end")
        entries[name] = data[at : at + size - 1]
        at += size - 1
    return entries, bool(data[0])


def _split(payload: bytes, entries: Entries | None) -> dict[int, Entry]:
    whole = {REST: Entry(payload, payload)}
    if entries is None:
        return whole
    try:
        return split_entries(payload, entries.field, entries.key, entries.ignored, entries.ignored_outside)
    except NotProtobufError:
        return whole  # not the table that the rule expects: then it changes as a whole

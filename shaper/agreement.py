"""What each side sends, takes and can read; and where the two sides' ideas of that differ.

The handshake carries a hash of each side's table. A side that does not hold the table with the peer's
hash asks for it, part by part, and both compare: topics on which they differ are named and refused on
both sides, all others go on.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from messages.payload import TopicEncoding
from shaper.errors import DecodeError
from shaper.handshake import TABLE_HASH_BYTES
from shaper.key_expression import check_key_expression, matches
from shaper.traffic_class import TopicRule

if TYPE_CHECKING:
    from messages.dccl import FieldInfo

MAX_TABLE_BYTES = 1 << 20
MAX_PACKED_BYTES = 100_000
_SHOWN = 60  # characters of a value that differs
_SEPARATOR = "; "


@dataclass(frozen=True, slots=True)
class TopicTable:
    """One side's declarations.

    sends: by key expression, what both sides must mean alike. takes: key expressions that it accepts.
    reads: descriptions of the encodings that it can read.
    """

    sends: Mapping[str, Mapping[str, str]]
    takes: tuple[str, ...]
    reads: tuple[str, ...]

    def packed(self) -> bytes:
        """As it crosses the link."""
        document = {"sends": self.sends, "takes": self.takes, "reads": self.reads}
        text = json.dumps(document, sort_keys=True, separators=(",", ":"))
        return zlib.compress(text.encode(), 9)


@dataclass(frozen=True, slots=True)
class Difference:
    """A topic that is not meant alike: the first field that differs, and both values."""

    topic: str
    field: str
    sender: str
    receiver: str

    def text(self, *, ours: bool) -> str:
        """For people. ours: whether this side is the sender."""
        here, there = (self.sender, self.receiver) if ours else (self.receiver, self.sender)
        return f"{self.topic}: {self.field} is {_shown(here)} here and {_shown(there)} on the other side"


def make_table(
    rules: Iterable[TopicRule], accept: Iterable[str], encodings: Mapping[str, TopicEncoding]
) -> TopicTable:
    """This side's table. encodings: by digest, those that it can read."""
    sends = {rule.key_expression: _declaration(rule) for rule in rules}
    return TopicTable(sends, tuple(accept), tuple(sorted(_meaning(e) for e in encodings.values())))


def table_hash(packed: bytes) -> bytes:
    """By which the peer knows a table."""
    return hashlib.sha256(packed).digest()[:TABLE_HASH_BYTES]


def unpack_table(packed: bytes) -> TopicTable:
    """Undo `packed`. Raises DecodeError and nothing else, whatever the bytes."""
    try:
        unpacker = zlib.decompressobj()
        text = unpacker.decompress(packed, MAX_TABLE_BYTES)
        document = json.loads(text)
        sends, takes, reads = document["sends"], document["takes"], document["reads"]
        table = TopicTable(
            {_text(key): {_text(k): _text(v) for k, v in row.items()} for key, row in sends.items()},
            tuple(_text(key) for key in takes),
            tuple(_text(line) for line in reads),
        )
    except (zlib.error, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise DecodeError(f"a topic table cannot be read: {error!r}") from error
    for key in (*table.sends, *table.takes):
        if check_key_expression(key) is not None:
            raise DecodeError(f"a topic table names {key!r}, which is no key expression")
    return table


def differences(sender: TopicTable, receiver: TopicTable) -> list[Difference]:
    """The topics of one side that the other does not mean alike, in the sender's order."""
    found = []
    readable = set(receiver.reads)
    for key, row in sender.sends.items():
        theirs = receiver.sends.get(key)  # both declare it: then alike
        for field in sorted(row) if theirs is not None else ():
            if theirs is not None and theirs.get(field, "") != row[field]:
                found.append(Difference(key, field, row[field], theirs.get(field, "")))
                break
        else:
            encoding = row.get("encoding", "")
            if encoding and encoding not in readable:
                found.append(_encoding_difference(key, encoding, receiver.reads))
            elif not any(_may_meet(expression, key) for expression in receiver.takes):
                takes = ", ".join(receiver.takes) or "nothing"
                found.append(Difference(key, "link.accept", "to be sent", f"only {takes}"))
    return found


def _declaration(rule: TopicRule) -> dict[str, str]:
    traffic_class = rule.traffic_class
    return {
        "class": traffic_class.name,
        "encoding": "" if rule.encoding is None else _meaning(rule.encoding),
        "keep": traffic_class.keep.value,
        "reliable": str(traffic_class.reliable).lower(),
        "ttl_ms": str(traffic_class.ttl_ns // 1_000_000),
    }


def _meaning(encoding: TopicEncoding) -> str:
    """An encoding in parts, of which the first that differs can be named: kind, fields, all the rest."""
    # Imported here: what codecs take to load is not for shapers without encodings.
    from messages.dccl.info import describe
    from messages.payload.bounded import BoundedEncoding

    kind = " ".join(encoding.description.split(" ")[:2])
    fields = []
    if isinstance(encoding, BoundedEncoding):
        fields = [_field(field) for field in describe(encoding.codec.schema).fields]
    return _SEPARATOR.join([kind, *fields, f"as a whole: {encoding.description}"])


def _field(field: FieldInfo) -> str:
    bounds = "" if field.minimum is None else f" {field.minimum:g} to {field.maximum:g}"
    steps = "" if field.resolution is None else f" by {field.resolution:g}"
    return f"{field.path}: {field.type_name}{bounds}{steps}"


def _encoding_difference(key: str, encoding: str, reads: tuple[str, ...]) -> Difference:
    """Against the receiver's encoding that has most in common with it from the start."""
    parts = encoding.split(_SEPARATOR)
    nearest = max((line.split(_SEPARATOR) for line in reads), key=partial(_common, parts), default=[])
    at = _common(parts, nearest)
    if at == 0:  # not even of the same kind
        return Difference(key, "encoding", parts[0], "none of its kind")
    ours = parts[at] if at < len(parts) else "not there"
    theirs = nearest[at] if at < len(nearest) else "not there"
    field = ours.partition(":")[0]
    return Difference(key, f"field {field!r} of {parts[0]}", _value(ours), _value(theirs))


def _common(a: list[str], b: list[str]) -> int:
    """How many parts are the same from the start."""
    return next((i for i, (x, y) in enumerate(zip(a, b, strict=False)) if x != y), min(len(a), len(b)))


def _value(part: str) -> str:
    return part.partition(": ")[2] or part


def _may_meet(expression: str, key: str) -> bool:
    """Whether a key expression may take something of another's; wrong only in favour of yes."""
    if "*" not in key:
        return matches(expression, key)
    if "*" not in expression:
        return matches(key, expression)
    for ours, theirs in zip(expression.split("/"), key.split("/"), strict=False):
        if "*" in ours or "*" in theirs:
            return True
        if ours != theirs:
            return False
    return True


def _shown(value: str) -> str:
    return repr(value if len(value) <= _SHOWN else value[: _SHOWN - 3] + "...")


def _text(value: object) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is no text")
    return value

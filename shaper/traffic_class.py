"""Traffic classes and topic rules: what a message is worth to the link."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

from messages.payload import TopicEncoding
from shaper.key_expression import matches


class Keep(Enum):
    """What a topic's queue holds while the link is busy."""

    LATEST = "latest"  # one slot per key, the newest sample wins
    ALL = "all"  # a bounded FIFO
    CHANGES = "changes"  # a state that both sides share; only what differs from it crosses


class Compression(Enum):
    """How a payload that no schema of ours describes is packed."""

    RAW = "raw"
    ZSTD = "zstd"


@dataclass(frozen=True, slots=True)
class TrafficClass:
    """How the messages of a class are queued, ordered and protected.

    tier: strict priority, 0 first. Tier 0 is the emergency stop: it waits for no pacing.
    ttl_ns: how long after its capture a message is worth sending, and delivering.
    depth: messages that a `Keep.ALL` queue holds; the oldest leaves first when it is full.
    always_send: passes while the link is held (silent, or full). For small, rare beats only.
    reliable: delivered once and in order, or reported expired; repeated while it is not acknowledged.
    max_parity_ratio: repair bytes at most, of a message in several datagrams; 0 for no parity.
    target_ratio: probability with which such a message shall arrive; it sets the parity with the loss.
    """

    name: str
    tier: int
    keep: Keep
    ttl_ns: int
    depth: int = 64
    always_send: bool = False
    reliable: bool = False
    max_parity_ratio: float = 0.0
    target_ratio: float = 0.985


@dataclass(frozen=True, slots=True)
class Entries:
    """How a protobuf message is a table: a repeated field whose items have a key of their own.

    All are field numbers. With `Keep.CHANGES` only the items that changed cross; an item that differs
    only in `ignored` fields, or a message that does so outside its items in `ignored_outside`, has not
    changed.
    """

    field: int
    key: int
    ignored: frozenset[int] = frozenset()
    ignored_outside: frozenset[int] = frozenset()


@dataclass(frozen=True, slots=True)
class TopicRule:
    """Which keys cross the link, and how.

    min_period_ns: decimation; at most one sample per period is accepted, 0 accepts all.
    weight: share of the tier's bytes, relative to the tier's other topics.
    pull: there is no publisher; the shaper asks for an item when the link has room for it, at most once
    per period.
    encoding: what becomes of a payload on its way; the peer must have the same one.
    """

    key_expression: str
    traffic_class: TrafficClass
    min_period_ns: int = 0
    compression: Compression = Compression.RAW
    weight: float = 1.0
    entries: Entries | None = None
    pull: bool = False
    encoding: TopicEncoding | None = None


def first_match(rules: Iterable[TopicRule], key: str) -> TopicRule | None:
    """The rule of a key: the first that matches, in the order of the configuration."""
    return next((rule for rule in rules if matches(rule.key_expression, key)), None)


_SECOND_NS = 1_000_000_000

DEFAULT_CLASSES: dict[str, TrafficClass] = {
    c.name: c
    for c in (
        TrafficClass(
            "emergency", tier=0, keep=Keep.ALL, ttl_ns=2 * _SECOND_NS, always_send=True, reliable=True
        ),
        TrafficClass("heartbeat", tier=1, keep=Keep.LATEST, ttl_ns=5 * _SECOND_NS, always_send=True),
        TrafficClass("command", tier=2, keep=Keep.ALL, ttl_ns=10 * _SECOND_NS, reliable=True),
        TrafficClass("plan", tier=2, keep=Keep.ALL, ttl_ns=120 * _SECOND_NS, reliable=True),
        TrafficClass("status", tier=3, keep=Keep.CHANGES, ttl_ns=3600 * _SECOND_NS),
        TrafficClass("state", tier=3, keep=Keep.LATEST, ttl_ns=2 * _SECOND_NS),
        TrafficClass("perception", tier=4, keep=Keep.LATEST, ttl_ns=20 * _SECOND_NS, max_parity_ratio=0.5),
        TrafficClass("bulk", tier=5, keep=Keep.ALL, ttl_ns=60 * _SECOND_NS, depth=16, max_parity_ratio=0.5),
    )
}
"""The classes that a configuration may name without declaring them."""

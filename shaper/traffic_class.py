"""Traffic classes and topic rules: what a message is worth to the link."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

from shaper.key_expression import matches


class Keep(Enum):
    """What a topic's queue holds while the link is busy."""

    LATEST = "latest"  # one slot per key, the newest sample wins
    ALL = "all"  # a bounded FIFO


class Compression(Enum):
    """How a payload that no schema of ours describes is packed."""

    RAW = "raw"
    ZSTD = "zstd"


@dataclass(frozen=True, slots=True)
class TrafficClass:
    """How the messages of a class are queued and ordered.

    tier: strict priority, 0 first. Tier 0 is the emergency stop: it waits for no pacing.
    ttl_ns: how long after its capture a message is worth sending.
    depth: messages that a `Keep.ALL` queue holds; the oldest leaves first when it is full.
    always_send: passes while the link is held (silent, or full). For small, rare beats only.
    """

    name: str
    tier: int
    keep: Keep
    ttl_ns: int
    depth: int = 64
    always_send: bool = False


@dataclass(frozen=True, slots=True)
class TopicRule:
    """Which keys cross the link, and how.

    min_period_ns: decimation; at most one sample per period is accepted, 0 accepts all.
    """

    key_expression: str
    traffic_class: TrafficClass
    min_period_ns: int = 0
    compression: Compression = Compression.RAW


def first_match(rules: Iterable[TopicRule], key: str) -> TopicRule | None:
    """The rule of a key: the first that matches, in the order of the configuration."""
    return next((rule for rule in rules if matches(rule.key_expression, key)), None)


_SECOND_NS = 1_000_000_000

DEFAULT_CLASSES: dict[str, TrafficClass] = {
    c.name: c
    for c in (
        TrafficClass("emergency", tier=0, keep=Keep.ALL, ttl_ns=2 * _SECOND_NS, always_send=True),
        TrafficClass("heartbeat", tier=1, keep=Keep.LATEST, ttl_ns=5 * _SECOND_NS, always_send=True),
        TrafficClass("command", tier=2, keep=Keep.ALL, ttl_ns=10 * _SECOND_NS),
        TrafficClass("state", tier=3, keep=Keep.LATEST, ttl_ns=2 * _SECOND_NS),
        TrafficClass("perception", tier=4, keep=Keep.LATEST, ttl_ns=20 * _SECOND_NS),
        TrafficClass("bulk", tier=5, keep=Keep.ALL, ttl_ns=60 * _SECOND_NS, depth=16),
    )
}
"""The classes that a configuration may name without declaring them."""

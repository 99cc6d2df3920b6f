"""What an endpoint needs to know before it starts, and what it counts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from shaper.incoming import Limits
from shaper.traffic_class import TopicRule
from shaper.wire_type import Encodings


@dataclass(frozen=True, slots=True)
class EndpointSettings:
    """What an endpoint needs to know; `shaper.config` makes it from TOML.

    rules: topics that this side sends, first match wins. accept: key expressions that it takes.
    max_datagram_bytes: UDP payload, excluding IP and UDP headers. protection_bytes: what the channel adds
    to each datagram; part of max_datagram_bytes.
    guaranteed: by tier, the share (0..1) of the bytes that it gets whatever the tiers above it want.
    encodings: by digest, those in which this side can read messages (`shaper.wire_type.by_digest`).
    """

    rules: tuple[TopicRule, ...]
    accept: tuple[str, ...] = ("**",)
    max_datagram_bytes: int = 1200
    limits: Limits = field(default_factory=Limits)
    guaranteed: Mapping[int, float] = field(default_factory=dict)
    encodings: Encodings = field(default_factory=dict)
    protection_bytes: int = 0


@dataclass(slots=True)
class Counters:
    """Datagrams, and why some were dropped."""

    sent_datagrams: int = 0
    sent_wire_bytes: int = 0
    received_datagrams: int = 0
    received_wire_bytes: int = 0
    malformed: int = 0
    duplicate: int = 0
    stale_epoch: int = 0

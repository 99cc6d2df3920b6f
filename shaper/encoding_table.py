"""Which encodings a side uses and can read, as the two ends of a link can compare them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass

from messages.payload import digest_of
from messages.payload.topic_encoding import DIGEST_BYTES
from shaper.traffic_class import TopicRule
from shaper.wire_type import Encodings


@dataclass(frozen=True, slots=True)
class EncodedTopic:
    """Topics that a side sends in another form. description: all that both must agree on, in a line."""

    key_expression: str
    digest: str
    description: str


def encoded_topics(rules: Iterable[TopicRule]) -> tuple[EncodedTopic, ...]:
    """What the peer must be able to read, in the order of the rules."""
    return tuple(
        EncodedTopic(rule.key_expression, digest_of(rule.encoding), rule.encoding.description)
        for rule in rules
        if rule.encoding is not None
    )


def unreadable(topics: Iterable[EncodedTopic], encodings: Encodings) -> tuple[EncodedTopic, ...]:
    """Those of a peer's topics that a side with these encodings cannot read."""
    return tuple(topic for topic in topics if topic.digest not in encodings)


def encodings_hash(encodings: Encodings) -> bytes:
    """8 bytes that are the same on two sides exactly if both have the same encodings."""
    text = "\n".join(sorted(encodings))
    return hashlib.sha256(text.encode()).digest()[:DIGEST_BYTES]

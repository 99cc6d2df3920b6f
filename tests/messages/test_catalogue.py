"""The table of topics is sound: unique keys, valid on Zenoh, every type importable."""

from __future__ import annotations

import re
from typing import get_args

from messages.catalogue import CATALOGUE, TrafficClassName, find_topic


def test_keys_are_unique_and_valid_on_zenoh_and_mcap() -> None:
    keys = [topic.key for topic in CATALOGUE]
    assert len(set(keys)) == len(keys)
    for topic in CATALOGUE:
        assert re.fullmatch(r"[a-z][a-z0-9_]*(/[a-z][a-z0-9_]*)+", topic.key), topic.key
        assert topic.mcap_topic == "/" + topic.key


def test_the_first_chunk_of_a_key_tells_its_direction() -> None:
    for topic in CATALOGUE:
        assert topic.key.startswith({"down": "robot/", "up": "operator/"}[topic.direction])


def test_every_traffic_class_is_a_built_in_one() -> None:
    assert {topic.traffic_class for topic in CATALOGUE} <= set(get_args(TrafficClassName))


def test_schemas_come_from_foxglove_or_from_us() -> None:
    for topic in CATALOGUE:
        package, _, name = topic.schema_name.partition(".")
        assert package in ("foxglove", "straitlink")
        assert name == topic.message_type.__name__


def test_a_key_finds_its_row_and_an_unknown_key_finds_none() -> None:
    for topic in CATALOGUE:
        assert find_topic(topic.key) is topic
    assert find_topic("/robot/heartbeat") is None
    assert find_topic("robot/unknown") is None

"""State topics as differences: against what has arrived, so that neither loss nor a restart stalls them."""

from __future__ import annotations

import math
import random
from pathlib import Path

import pytest
from google.protobuf.message import Message

from messages.dccl import Codec, SchemaError
from messages.payload.delta import DeltaEncoding
from shaper.config import load_config
from shaper.errors import ConfigError
from shaper.events import Delivered
from shaper.traffic_class import DEFAULT_CLASSES, TopicRule
from shaper.wire_type import by_digest
from tests.messages.dccl.declare import Declared, declare, number
from tests.messages.payload.robots import write_schema
from tests.shaper.pair import MS, RULES, Pair, S, Side
from tests.shaper.test_config import MINIMAL

KEY = "robot/state/joints"
JOINTS = declare(
    number("j", -4, 4, "double", "repeated", resolution=0.001, min_repeat=20, max_repeat=20),
    codec_group="straitlink.1",
)
CODEC = Codec(JOINTS)
ALONE_BYTES = 34
TYPE = "application/protobuf;test.T"


def joints(step: int) -> Message:
    return JOINTS(j=[math.sin(step / 30 + k) for k in range(20)])


def pair() -> Pair:
    encoding = DeltaEncoding(JOINTS)
    rules = (TopicRule(KEY, DEFAULT_CLASSES["state"], encoding=encoding), *RULES)
    return Pair(rules=rules, encodings=by_digest([DeltaEncoding(JOINTS)]))


def run(world: Pair, steps: range) -> None:
    for step in steps:
        world.offer(world.robot, KEY, joints(step).SerializeToString(), encoding=TYPE)
        world.advance(100 * MS)


def taken(side: Side) -> list[Message]:
    return [JOINTS.FromString(e.payload) for e in side.events if isinstance(e, Delivered) and e.key == KEY]


def as_sent(steps: range) -> list[Message]:
    return [CODEC.decode(CODEC.encode(joints(step))) for step in steps]


def test_a_state_crosses_as_its_difference_to_what_has_arrived() -> None:
    world = pair()
    run(world, range(40))
    world.advance(1 * S)
    assert taken(world.operator) == as_sent(range(40))
    assert world.robot.endpoint.sent_ledgers()[KEY].sent_bytes < 40 * 0.7 * ALONE_BYTES


def test_what_is_lost_is_missed_and_nothing_after_it() -> None:
    world, chance = pair(), random.Random(3)
    run(world, range(3))
    world.robot.loses = lambda datagram: chance.random() < 0.3
    run(world, range(3, 60))
    world.robot.loses = lambda datagram: False
    run(world, range(60, 63))
    world.advance(1 * S)
    row = world.operator.endpoint.received_ledgers[KEY]
    assert row.lost > 5 and row.unreadable == 0
    came = taken(world.operator)
    assert len(came) == 63 - row.lost
    assert all(message in as_sent(range(63)) for message in came)


def test_a_message_that_is_overtaken_is_not_delivered_but_may_be_referred_to() -> None:
    world, chance = pair(), random.Random(4)
    world.robot.copies = lambda: (chance.choice([0, 0, 250 * MS]),)
    run(world, range(80))
    world.advance(2 * S)
    row = world.operator.endpoint.received_ledgers[KEY]
    assert row.stale > 5 and row.unreadable == 0
    assert all(message in as_sent(range(80)) for message in taken(world.operator))


@pytest.mark.parametrize("restarts", [["operator"], ["robot"], ["robot", "operator"]])
def test_a_restart_costs_a_moment_and_never_a_wrong_state(restarts: list[str]) -> None:
    world = pair()
    run(world, range(20))
    for side in restarts:
        world.restart(getattr(world, side))
    run(world, range(20, 60))
    world.advance(1 * S)
    came = taken(world.operator)
    assert as_sent(range(40, 60)) == came[-20:]
    assert all(message in as_sent(range(60)) for message in came)


def test_a_value_out_of_range_is_refused_and_the_stream_goes_on() -> None:
    world = pair()
    run(world, range(5))
    world.offer(world.robot, KEY, JOINTS(j=[9.0] * 20).SerializeToString(), encoding=TYPE)
    run(world, range(5, 10))
    world.advance(1 * S)
    assert taken(world.operator) == as_sent(range(10))
    assert world.robot.endpoint.sent_ledgers()[KEY].refused == 1


def test_a_schema_with_text_has_no_differences() -> None:
    with pytest.raises(SchemaError, match="name is no number"):
        DeltaEncoding(declare(Declared("name", "string", "required", {"max_length": 9})))


def configure(folder: Path, table: str, topic: str = "") -> None:
    write_schema(folder)
    path = folder / "side.toml"
    path.write_text(f'{MINIMAL}{topic}encoding = "joints"\n[encodings.joints]\n{table}')
    load_config(path)


def test_delta_is_for_topics_of_which_the_latest_counts(tmp_path: Path) -> None:
    configure(tmp_path, 'proto = "g1.proto"\ndelta = true\n')
    with pytest.raises(ConfigError, match=r'expected a class with keep = "latest"'):
        configure(tmp_path, 'proto = "g1.proto"\ndelta = true\n[classes.state]\nkeep = "all"\n')

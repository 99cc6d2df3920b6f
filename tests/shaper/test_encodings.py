"""A topic's payloads cross in another form, are told from those that do not, and every failure is counted."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest

from messages.payload import Encoded, Payload, PayloadError, TopicEncoding
from shaper.encoding_table import encoded_topics, encodings_hash, unreadable
from shaper.events import Delivered, EncodingTrouble
from shaper.frames import MessageFrame
from shaper.traffic_class import DEFAULT_CLASSES, TopicRule
from shaper.trouble import REPEAT_NS
from shaper.wire_type import WIRE_TYPE_BYTES, by_digest, split_wire_type, wire_type
from tests.shaper.pair import MS, RULES, Pair, S, Side

JOINTS, COMMAND = "robot/state/joints", "robot/command/arm"
TYPE = "application/cdr;sensor_msgs/msg/JointState"


@dataclass
class Halving:
    """Payloads of pairs of equal bytes cross as one byte of each, from "A" on; "z" is sent as "y"."""

    description: str = "halving"
    encoded: int = 0

    def encode(self, payload: Payload) -> Encoded:
        self.encoded += 1
        if payload.data[::2] != payload.data[1::2]:
            raise PayloadError(f"halving: {payload.data!r} is not in pairs")
        altered = "z clamped to y" if b"z" in payload.data else ""
        return Encoded(payload.data[::2].replace(b"z", b"y"), altered)

    def decode(self, data: bytes, bus_type: str, max_bytes: int, capture_unix_ns: int | None) -> Payload:
        if min(data, default=65) < 65:
            raise PayloadError(f"halving: byte {min(data)} is below 65")
        return Payload(bytes(b for byte in data for b in (byte, byte)), bus_type)


def pair_with(encoding: TopicEncoding, *known_there: TopicEncoding) -> Pair:
    rules = [
        TopicRule(key, DEFAULT_CLASSES[name], encoding=encoding)
        for key, name in ((JOINTS, "state"), (COMMAND, "command"))
    ]
    return Pair(rules=(*rules, *RULES), encodings=by_digest(known_there))


def troubles(side: Side) -> list[EncodingTrouble]:
    return [event for event in side.events if isinstance(event, EncodingTrouble)]


def delivered(side: Side) -> list[tuple[str, bytes, str]]:
    return [(e.key, e.payload, e.encoding) for e in side.events if isinstance(e, Delivered)]


def test_a_payload_crosses_encoded_and_comes_out_as_it_was_with_its_own_type() -> None:
    pair = pair_with(Halving(), Halving())
    for payload in (b"aabb", b"ccdd"):
        pair.offer(pair.robot, JOINTS, payload, encoding=TYPE)
        pair.advance(1 * S)
    assert delivered(pair.operator) == [(JOINTS, b"aabb", TYPE), (JOINTS, b"ccdd", TYPE)]
    ledger = pair.robot.endpoint.sent_ledgers()[JOINTS]
    assert (ledger.offered, ledger.sent, ledger.sent_bytes) == (2, 2, 4)
    assert pair.operator.endpoint.received_ledgers[JOINTS].received_bytes == 4


def test_only_what_leaves_is_encoded() -> None:
    encoding = Halving()
    pair = pair_with(encoding, encoding)
    for _ in range(50):
        pair.offer(pair.robot, JOINTS, b"aa", pumped=False)
    pair.offer(pair.robot, JOINTS, b"bb")
    pair.advance(1 * S)
    assert encoding.encoded == 1
    assert [payload for _, payload, _ in delivered(pair.operator)] == [b"bb"]


def test_what_cannot_be_encoded_is_counted_and_told_with_its_reason() -> None:
    pair = pair_with(Halving(), Halving())
    for payload in (b"aa", b"ab", b"cc"):
        pair.offer(pair.robot, JOINTS, payload)
        pair.advance(1 * S)
    assert [payload for _, payload, _ in delivered(pair.operator)] == [b"aa", b"cc"]
    ledger = pair.robot.endpoint.sent_ledgers()[JOINTS]
    assert (ledger.offered, ledger.refused, ledger.sent, ledger.queued) == (3, 1, 2, 0)
    assert troubles(pair.robot) == [EncodingTrouble(JOINTS, "refused", "halving: b'ab' is not in pairs", 1)]
    assert pair.operator.endpoint.peer_ledgers.sent[JOINTS].refused == 1


def test_a_topic_that_fails_all_the_time_is_told_once_in_ten_seconds() -> None:
    pair = pair_with(Halving(), Halving())
    for _ in range(100):
        pair.offer(pair.robot, JOINTS, b"ab")
        pair.advance(REPEAT_NS // 50)
    told = troubles(pair.robot)
    assert [t.count for t in told] == [1, 50]
    assert pair.robot.endpoint.sent_ledgers()[JOINTS].refused == 100


def test_a_clamped_value_is_sent_and_told() -> None:
    pair = pair_with(Halving(), Halving())
    pair.offer(pair.robot, JOINTS, b"zz")
    pair.advance(1 * S)
    assert [payload for _, payload, _ in delivered(pair.operator)] == [b"yy"]
    assert [(t.what, t.reason) for t in troubles(pair.robot)] == [("altered", "z clamped to y")]
    assert pair.robot.endpoint.sent_ledgers()[JOINTS].altered == 1


@pytest.mark.parametrize("there", [(), (Halving("another schema"),)])
def test_a_receiver_without_the_encoding_says_so_and_takes_the_other_topics(
    there: tuple[TopicEncoding, ...],
) -> None:
    pair = pair_with(Halving(), *there)
    for _ in range(3):
        pair.offer(pair.robot, JOINTS, b"aa")
        pair.offer(pair.robot, "robot/state/pose", b"p")
        pair.advance(1 * S)
    assert [key for key, _, _ in delivered(pair.operator)] == ["robot/state/pose"] * 3
    row = pair.operator.endpoint.received_ledgers[JOINTS]
    assert (row.delivered, row.lost, row.unreadable) == (0, 0, 3)
    (told,) = troubles(pair.operator)
    assert told.what == "unreadable" and "digest" in told.reason
    assert pair.robot.endpoint.peer_ledgers.received[JOINTS].unreadable == 3


def test_bytes_that_the_encoding_cannot_read_harm_nothing_else_in_their_datagram() -> None:
    class Wrong(Halving):
        def encode(self, payload: Payload) -> Encoded:
            return Encoded(b"\0")

    pair = pair_with(Wrong(), Halving())
    pair.offer(pair.robot, JOINTS, b"aa", pumped=False)
    pair.offer(pair.robot, "robot/state/pose", b"p")
    pair.advance(1 * S)
    assert [key for key, _, _ in delivered(pair.operator)] == ["robot/state/pose"]
    assert pair.operator.endpoint.received_ledgers[JOINTS].unreadable == 1
    assert pair.operator.endpoint.counters.malformed == 0


def test_the_publisher_of_a_command_learns_that_it_was_refused_or_not_readable() -> None:
    pair = pair_with(Halving(), Halving())
    pair.offer(pair.robot, COMMAND, b"ab", tag=1)
    pair.offer(pair.robot, COMMAND, b"aa", tag=2)
    pair.offer(pair.robot, COMMAND, b"##", tag=3)
    pair.offer(pair.robot, COMMAND, b"bb", tag=4)
    pair.advance(3 * S)
    assert pair.robot.stages(1) == ["queued", "refused"]
    assert pair.robot.stages(2) == pair.robot.stages(4) == ["queued", "sent", "delivered"]
    assert pair.robot.stages(3) == ["queued", "sent", "unreadable"]
    assert [payload for _, payload, _ in delivered(pair.operator)] == [b"aa", b"bb"]
    ledger = pair.robot.endpoint.sent_ledgers()[COMMAND]
    assert (ledger.offered, ledger.refused, ledger.sent, ledger.queued) == (4, 1, 3, 0)


def test_a_topic_that_is_refused_throughout_sends_nothing_and_lets_the_endpoint_sleep() -> None:
    pair = pair_with(Halving(), Halving())
    for _ in range(50):
        pair.offer(pair.robot, JOINTS, b"ab")
        pair.advance(20 * MS)
    assert pair.robot.frames(MessageFrame) == []
    assert pair.robot.wakeup_ns > pair.now_ns


def test_the_type_on_the_wire_names_the_encoding_and_can_be_split_again() -> None:
    named = wire_type(Halving(), TYPE)
    digest, bus_type = split_wire_type(named)
    assert (len(digest), bus_type) == (16, TYPE)
    assert by_digest([Halving()]).keys() == {digest}
    assert len(named) - len(TYPE) == WIRE_TYPE_BYTES
    assert split_wire_type(wire_type(None, TYPE)) == ("", TYPE)
    assert split_wire_type("straitlink/") == ("", "")
    assert digest != split_wire_type(wire_type(replace(Halving(), description="x"), TYPE))[0]


def test_two_sides_can_compare_what_one_sends_with_what_the_other_reads() -> None:
    one, other = Halving(), Halving("another schema")
    rules = [
        TopicRule(key, DEFAULT_CLASSES["state"], encoding=encoding)
        for key, encoding in (("robot/a", one), ("robot/b", other), ("robot/c", None))
    ]
    topics = encoded_topics(rules)
    assert [(t.key_expression, t.description) for t in topics] == [
        ("robot/a", "halving"),
        ("robot/b", "another schema"),
    ]
    assert unreadable(topics, by_digest([one, other])) == ()
    assert [t.key_expression for t in unreadable(topics, by_digest([one]))] == ["robot/b"]
    assert encodings_hash(by_digest([one, other])) == encodings_hash(by_digest([other, one]))
    assert encodings_hash(by_digest([one])) != encodings_hash(by_digest([other]))

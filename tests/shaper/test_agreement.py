"""Where the two sides' tables differ is told on both by name; the other topics go on."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from hypothesis import given
from hypothesis import strategies as st

from messages.payload.bounded import BoundedEncoding
from messages.proto.dccl import option_extensions_pb2 as options
from shaper.agreement import TopicTable, differences, make_table, table_hash, unpack_table
from shaper.endpoint_settings import EndpointSettings
from shaper.errors import DecodeError
from shaper.handshake import Side
from shaper.notices import NoticeKind
from shaper.table_exchange import TableExchange
from shaper.traffic_class import DEFAULT_CLASSES, TopicRule
from shaper.wire_type import by_digest
from tests.shaper.pair import S
from tests.shaper.secured import Host, SecuredPair


def encoding(maximum: float = 10.0, name: str = "Depth") -> BoundedEncoding:
    file = descriptor_pb2.FileDescriptorProto(
        name=f"{name}{maximum}.proto", package="t", dependency=["dccl/option_extensions.proto"]
    )
    file.dependency[:] = [options.DESCRIPTOR.name]
    message = file.message_type.add(name=name)
    message.options.Extensions[options.msg].id = 124
    message.options.Extensions[options.msg].max_bytes = 32
    message.options.Extensions[options.msg].codec_version = 4
    for number, (field, high) in enumerate((("x_m", 5.0), ("depth_m", maximum)), 1):
        row = message.field.add(name=field, number=number, type=1, label=1)
        bounds = row.options.Extensions[options.field]
        bounds.min, bounds.max, bounds.precision = 0, high, 1
    pool = descriptor_pool.DescriptorPool()
    for known in (descriptor_pb2.DESCRIPTOR, options.DESCRIPTOR):
        pool.AddSerializedFile(known.serialized_pb)
    pool.AddSerializedFile(file.SerializeToString())
    made: Any = message_factory.GetMessageClass(pool.FindMessageTypeByName(f"t.{name}"))
    return BoundedEncoding(made)


COMMAND, STATE = DEFAULT_CLASSES["command"], DEFAULT_CLASSES["state"]


def settings(*rules: TopicRule, accept: tuple[str, ...] = ("**",), reads: Any = ()) -> EndpointSettings:
    return EndpointSettings(rules, accept, encodings=by_digest(reads))


def meet(robot: EndpointSettings, operator: EndpointSettings) -> SecuredPair:
    tables: dict[Side, EndpointSettings] = {"robot": robot, "operator": operator}
    pair = SecuredPair(tables=tables)
    pair.advance(10 * S)
    return pair


def told(host: Host) -> str:
    text, *_ = host.notices(NoticeKind.TABLE_DIFFERS)
    return text


def test_sides_that_agree_say_so_once() -> None:
    pair = meet(settings(TopicRule("robot/a", STATE)), settings(TopicRule("operator/a", COMMAND)))
    for host in pair.hosts:
        assert len(host.notices(NoticeKind.TABLE_AGREES)) == 1
        assert not host.notices(NoticeKind.TABLE_DIFFERS)


def test_a_bound_that_differs_is_named_on_both_sides_with_topic_field_and_values() -> None:
    rules = (TopicRule("robot/depth", STATE, encoding=encoding(10.0)), TopicRule("robot/other", STATE))
    pair = meet(settings(*rules), settings(TopicRule("operator/a", COMMAND), reads=[encoding(20.0)]))
    for host, here, there in ((pair.robot, 10, 20), (pair.operator, 20, 10)):
        text = told(host)
        assert "robot/depth: field 'depth_m' of DCCL t.Depth is" in text
        assert text.index(f"0 to {here} by") < text.index(f"0 to {there} by")


def test_the_topics_on_which_they_agree_go_on_and_the_others_are_refused() -> None:
    rules = (TopicRule("robot/depth", STATE, encoding=encoding(10.0)), TopicRule("robot/other", STATE))
    pair = meet(settings(*rules), settings(TopicRule("operator/a", COMMAND)))
    pair.offer(pair.robot, "robot/other", b"fine")
    pair.offer(pair.robot, "robot/depth", b"not")
    pair.advance(1 * S)
    assert pair.operator.payloads == [b"fine"]
    assert pair.robot.link.endpoint.sent_ledgers()["robot/depth"].refused == 1


def test_a_topic_that_the_other_side_does_not_accept_is_named() -> None:
    pair = meet(
        settings(TopicRule("robot/image", STATE), TopicRule("robot/state/**", STATE)),
        settings(TopicRule("operator/a", COMMAND), accept=("robot/state/*",)),
    )
    assert "robot/image: link.accept" in told(pair.robot) and "only robot/state/*" in told(pair.robot)


def test_a_class_that_differs_where_both_declare_a_topic_is_named() -> None:
    ours = TopicRule("plan", COMMAND)
    theirs = TopicRule("plan", replace(COMMAND, ttl_ns=3 * S))
    pair = meet(settings(ours), settings(theirs))
    assert "plan: ttl_ms is '10000' here and '3000' on the other side" in told(pair.robot)


def test_a_restarted_side_with_a_mended_table_is_taken_back() -> None:
    pair = meet(
        settings(TopicRule("robot/a", STATE)), settings(TopicRule("operator/a", COMMAND), accept=("none",))
    )
    assert told(pair.robot)
    pair.tables["operator"] = settings(TopicRule("operator/a", COMMAND))
    pair.start(pair.operator)
    pair.advance(5 * S)
    pair.offer(pair.robot, "robot/a", b"again")
    pair.advance(1 * S)
    assert pair.operator.payloads == [b"again"]


def test_a_table_crosses_whatever_its_size_and_however_much_is_lost() -> None:
    rules = tuple(TopicRule(f"robot/{i * 7919 % 100_003}/{i}", STATE) for i in range(300))
    tables: dict[Side, EndpointSettings] = {"robot": settings(*rules), "operator": settings(rules[0])}
    pair = SecuredPair(tables=tables)
    pair.loses = lambda data, to: pair.rng.random() < 0.2
    pair.advance(60 * S)
    assert pair.operator.notices(NoticeKind.TABLE_AGREES)


@given(st.binary(max_size=600))
def test_reading_any_table_returns_or_raises_a_decode_error(data: bytes) -> None:
    with pytest.raises(DecodeError):
        unpack_table(data)


def test_a_table_that_unpacks_to_too_much_is_refused() -> None:
    huge = TopicTable({"a": {"class": "x" * 4_000_000}}, (), ()).packed()
    with pytest.raises(DecodeError):
        unpack_table(huge)


@given(st.lists(st.binary(max_size=420), max_size=8))
def test_parts_that_were_not_asked_for_change_nothing(parts: list[bytes]) -> None:
    exchange = TableExchange(make_table([TopicRule("a", STATE)], ["**"], {}))
    exchange.meet(b"12345678", 0)
    for part in parts:
        exchange.on_part(b"\x04" + part, 1)
    assert exchange.refused_here == () and sum(map(len, exchange._parts)) <= 100_000


def test_a_hash_stands_for_one_table() -> None:
    table = make_table([TopicRule("a", STATE)], ["**"], {})
    assert unpack_table(table.packed()) == table
    assert table_hash(table.packed()) != table_hash(make_table([TopicRule("b", STATE)], ["**"], {}).packed())
    assert differences(table, table) == []

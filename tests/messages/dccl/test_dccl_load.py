"""A declaration that cannot work fails when it is loaded, in a sentence that names what is wrong."""

from __future__ import annotations

from typing import Any

import pytest

from messages.dccl import ArithmeticModel, Codec, SchemaError
from tests.messages.dccl.declare import Declared, declare, number

BAD: list[tuple[str, list[Declared], dict[str, Any], list[str]]] = [
    ("no version", [], {"version": None}, ["test.T", "codec_version"]),
    ("version 5", [], {"version": 5}, ["codec_version = 5", "2, 3 or 4"]),
    ("no id", [], {"id": None}, ["test.T", "id"]),
    ("large id", [], {"id": 32768}, ["32768", "32767"]),
    ("no max_bytes", [], {"max_bytes": None}, ["max_bytes"]),
    ("too large", [number("x", 0, 2**40 - 1)], {"max_bytes": 5}, ["6 bytes", "max_bytes = 5"]),
    ("no bounds", [Declared("x", "double")], {}, ["test.T.x", "min"]),
    ("no max", [Declared("x", "double", options={"min": 0})], {}, ["test.T.x", "max"]),
    ("crossed bounds", [number("x", 3, 2)], {}, ["test.T.x", "min = 3", "max = 2"]),
    ("NaN bound", [number("x", float("nan"), 2)], {}, ["test.T.x", "values of double"]),
    ("hidden method", [number("HasField", 0, 2)], {}, ["test.T.HasField", "rename the field"]),
    ("both steps", [number("x", 0, 1, precision=1, resolution=0.1)], {}, ["precision", "resolution"]),
    ("negative step", [number("x", 0, 1, resolution=-0.1)], {}, ["-0.1", "greater than 0"]),
    ("odd bounds", [number("x", 0, 1.05, resolution=0.1)], {}, ["max = 1.05", "multiple", "0.1"]),
    ("too fine", [number("x", 0, 1e9, precision=9)], {}, ["test.T.x", "2^53"]),
    ("beyond the type", [number("x", -1, 5, "uint32")], {}, ["test.T.x", "uint32"]),
    ("no length", [Declared("s", "string")], {}, ["test.T.s", "max_length"]),
    ("long string", [Declared("s", "string", options={"max_length": 256})], {"version": 2}, ["256", "255"]),
    ("no repeat", [number("x", 0, 1, label="repeated")], {}, ["test.T.x", "max_repeat"]),
    (
        "crossed repeat",
        [number("x", 0, 1, label="repeated", min_repeat=3, max_repeat=2)],
        {},
        ["min_repeat = 3", "max_repeat = 2"],
    ),
    (
        "early min_repeat",
        [number("x", 0, 1, label="repeated", min_repeat=1, max_repeat=2)],
        {"version": 2},
        ["min_repeat", "3 or 4"],
    ),
    ("oneof in 3", [number("x", 0, 1, label="optional", oneof="o")], {"version": 3}, ["oneof o", "4"]),
    (
        "oneof in head",
        [number("x", 0, 1, label="optional", in_head=True, oneof="o")],
        {},
        ["head", "oneof"],
    ),
    (
        "loose head",
        [Declared("s", "string", options={"max_length": 4, "in_head": True})],
        {},
        ["test.T.s", "3 to 35 bits", "fixed size"],
    ),
    ("unknown codec", [number("x", 0, 1, codec="acme")], {}, ["test.T.x", "'acme'", "dccl.time"]),
    ("presence in 2", [number("x", 0, 1, codec="dccl.presence")], {"version": 2}, ["dccl.presence"]),
    ("static", [Declared("x", "int32", options={"codec": "dccl.static"})], {}, ["static_value"]),
    (
        "odd static",
        [Declared("x", "int32", options={"codec": "dccl.static", "static_value": "high"})],
        {},
        ["'high'"],
    ),
    ("float time", [Declared("t", "float", options={"codec": "dccl.time"})], {}, ["dccl.time", "double"]),
    (
        "unpacked in 2",
        [Declared("e", "enum", enum=[("A", 1)], options={"packed_enum": False})],
        {"version": 2},
        ["packed_enum"],
    ),
    (
        "no model",
        [Declared("a", "int32", options={"codec": "dccl.arithmetic", "arithmetic": "gauss"})],
        {},
        ["'gauss'", "not given"],
    ),
    ("hash bounds", [number("h", 0, 100, "uint32", codec="dccl.hash")], {}, ["2^k - 1", "100"]),
]


@pytest.mark.parametrize(("fields", "options", "words"), [b[1:] for b in BAD], ids=[b[0] for b in BAD])
def test_a_declaration_that_cannot_work_is_refused_by_name(
    fields: list[Declared], options: dict[str, Any], words: list[str]
) -> None:
    version = options.pop("version", 4) if "version" in options else 4
    for declared in fields:
        declared.oneof = declared.options.pop("oneof", declared.oneof)
    with pytest.raises(SchemaError) as error:
        Codec(declare(*fields, version=version, **options))
    for word in words:
        assert word in str(error.value)


def test_a_message_of_exactly_max_bytes_loads() -> None:
    assert Codec(declare(number("x", 0, 2**40 - 1), max_bytes=6)).info().max_bytes == 6


def test_a_message_within_itself_is_refused() -> None:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    from messages.proto.dccl import option_extensions_pb2 as extensions

    file = descriptor_pb2.FileDescriptorProto(name="r.proto", package="test", syntax="proto2")
    message = file.message_type.add(name="Tree")
    options = message.options.Extensions[extensions.msg]
    options.id, options.max_bytes, options.codec_version = 1, 100, 4
    message.field.add(
        name="child",
        number=1,
        label=1,
        type=descriptor_pb2.FieldDescriptorProto.TYPE_MESSAGE,
        type_name=".test.Tree",
    )
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    tree = message_factory.GetMessageClass(pool.FindMessageTypeByName("test.Tree"))
    with pytest.raises(SchemaError, match="contains itself"):
        Codec(tree)


def test_out_of_range_must_name_a_field() -> None:
    with pytest.raises(SchemaError, match=r"'y', which is no field.*'x'"):
        Codec(declare(number("x", 0, 1)), out_of_range={"y": "clamp"})


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"value_bounds": (0, 1)}, "one more"),
        ({"value_bounds": (0, 2, 1)}, "must rise"),
        ({"frequencies": (0, 1)}, "at least 1"),
        ({"eof_frequency": 2**30}, "2^30"),
    ],
)
def test_an_arithmetic_model_is_checked_when_it_is_made(changes: dict[str, Any], word: str) -> None:
    fields: dict[str, Any] = {"name": "m", "frequencies": (1, 1), "value_bounds": (0, 1, 2), **changes}
    with pytest.raises(SchemaError) as error:
        ArithmeticModel(**fields)
    assert word in str(error.value) and "'m'" in str(error.value)

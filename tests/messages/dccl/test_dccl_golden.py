"""Bytes of a small schema of ours. Changing one of these is a decision."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from google.protobuf import json_format

from messages.dccl import Codec
from tests.messages.dccl.declare import Declared, declare, number

GOLDEN = json.loads((Path(__file__).resolve().parents[2] / "golden" / "dccl.json").read_text())
NOW_NS = 1_700_000_000_000_000_000


def schema(version: int) -> Codec[Any]:
    fields = [
        number("to", 0, 31, "uint32", in_head=True),
        number("x", -100, 100, precision=2),
        number("y", -100, 100, "float", "optional", precision=1),
        number("joint", -4, 4, "float", "repeated", precision=3, max_repeat=4),
        Declared("mode", "enum", "optional", enum=[("WALK", 4), ("DRIVE", 2), ("FALL", 9)]),
        Declared("ok", "bool", "optional"),
        Declared("name", "string", "optional", {"max_length": 6}),
        Declared("data", "bytes", "optional", {"max_length": 2}),
        Declared("part", "message", "optional", message=[number("n", -5, 5, "int32", "optional")]),
        Declared("t", "double", options={"codec": "dccl.time", "precision": 1}),
    ]
    if version == 4:
        fields += [number(name, 0, 9, "uint32", "optional") for name in ("left", "right")]
        for member in fields[-2:]:
            member.oneof = "side"
    return Codec(declare(*fields, version=version, id=200))


@pytest.mark.parametrize("case", GOLDEN["messages"], ids=lambda c: f"v{c['version']}-{c['name']}")
def test_a_message_is_these_bytes_and_these_bytes_are_the_message(case: dict[str, Any]) -> None:
    codec = schema(case["version"])
    message = json_format.ParseDict(case["value"], codec.message_type())
    assert codec.encode(message).hex() == case["hex"]
    assert codec.decode(bytes.fromhex(case["hex"]), NOW_NS) == message


def test_the_schema_hash_is_the_same_on_every_machine() -> None:
    assert {str(v): f"{schema(v).schema_hash:016x}" for v in (2, 3, 4)} == GOLDEN["schema_hash"]

"""Columns of numbers are encoded to the bytes of single messages."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from messages.dccl import Codec, DecodeError, EncodeError, SchemaError
from tests.messages.dccl.declare import Declared, declare, number

S = 1_000_000_000
NOW_S = 1_700_000_000

T = declare(
    number("to", 0, 31, "uint32", in_head=True),
    Declared("t", "uint64", options={"codec": "dccl.time", "precision": -3}),
    number("x", -1000, 1000, precision=3),
    number("n", -50, 50, "int32", label="optional"),
    Declared(
        "pose",
        "message",
        "optional",
        message=[number("y", -4, 4, "float", precision=3), Declared("ok", "bool")],
    ),
    number("joint", -4, 4, "float", label="repeated", precision=3, max_repeat=28),
    Declared("mode", "enum", "optional", enum=[("A", 7), ("B", -2), ("C", 40)]),
    number("big", 0, 2**50, "uint64"),
)


def columns(count: int) -> dict[str, Any]:
    source = np.random.default_rng(5)
    return {
        "to": source.integers(0, 32, count),
        "t": (NOW_S * 1000 + source.integers(-40_000_000, 40_000_000, count)) * 1000,
        "x": source.uniform(-1000, 1000, count),
        "n": source.integers(-50, 51, count),
        "pose.y": source.uniform(-4, 4, count).astype(np.float32),
        "pose.ok": source.integers(0, 2, count).astype(bool),
        "joint": source.uniform(-4, 4, (count, 28)).astype(np.float32),
        "mode": source.choice([7, -2, 40], count),
        "big": source.integers(0, 2**50, count),
    }


def one(given: dict[str, Any], row: int) -> Any:
    fields: dict[str, Any] = {name: values[row].tolist() for name, values in given.items() if "." not in name}
    pose = {"y": float(given["pose.y"][row]), "ok": bool(given["pose.ok"][row])}
    return T(**fields, pose=pose)


def test_each_row_is_the_message_of_its_columns() -> None:
    codec, given = Codec(T), columns(200)
    rows = codec.encode_many(given)
    assert [row.tobytes() for row in rows] == [codec.encode(one(given, i)) for i in range(200)]


def test_columns_come_back_as_single_messages_do() -> None:
    codec, given = Codec(T), columns(200)
    back = codec.decode_many(codec.encode_many(given), NOW_S * S)
    for i in range(200):
        assert one(back, i) == codec.decode(codec.encode(one(given, i)), NOW_S * S)


def test_a_number_out_of_bounds_is_treated_as_for_single_messages() -> None:
    given = columns(3)
    given["x"] = np.array([0.0, 2000.0, -2000.0])
    with pytest.raises(
        EncodeError, match=r"x = 2000\.0 in row 1 is not a value within its bounds -1000 to 1000"
    ):
        Codec(T).encode_many(given)
    clamped = Codec(T, out_of_range="clamp")
    assert clamped.decode_many(clamped.encode_many(given), NOW_S * S)["x"].tolist() == [0, 1000, -1000]
    silent = Codec(T, out_of_range="dccl")
    assert silent.decode_many(silent.encode_many(given), NOW_S * S)["x"].tolist() == [0, -1000, -1000]


def test_nan_is_refused_in_a_column() -> None:
    given = columns(2)
    given["joint"][1, 3] = np.nan
    for treatment in ("raise", "clamp"):
        with pytest.raises(EncodeError, match="joint = nan in row 1"):
            Codec(T, out_of_range=treatment).encode_many(given)  # type: ignore[arg-type]


def test_columns_must_be_those_of_the_message() -> None:
    given = columns(2)
    del given["big"]
    with pytest.raises(EncodeError, match="the columns differ from its fields in: big"):
        Codec(T).encode_many(given)
    with pytest.raises(EncodeError, match=r"joint has the shape \(2, 5\)"):
        Codec(T).encode_many({**columns(2), "joint": np.zeros((2, 5))})


def test_rows_of_another_message_are_refused() -> None:
    codec = Codec(T)
    rows = codec.encode_many(columns(4)).copy()
    rows[2, 0] ^= 0x10
    with pytest.raises(DecodeError, match="row 2 has another id"):
        codec.decode_many(rows, NOW_S * S)
    with pytest.raises(DecodeError, match="are not"):
        codec.decode_many(rows[:, :5], NOW_S * S)


def test_a_type_without_a_fixed_layout_is_refused() -> None:
    with pytest.raises(SchemaError, match="s has no fixed place"):
        Codec(declare(Declared("s", "string", options={"max_length": 4}))).encode_many({})

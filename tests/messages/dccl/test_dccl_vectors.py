"""The bytes of the C++ library, where the reference data is at hand."""

from __future__ import annotations

import importlib.util
import json
import math
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from google.protobuf import json_format

from messages.dccl import ArithmeticModel, Codec, EncodeError, load_proto

VECTORS = Path(__file__).resolve().parents[4] / "shared" / "data" / "dccl_vectors"
NOW_S = 1_700_000_538  # of the bench vectors, which state no clock

pytestmark = pytest.mark.skipif(not VECTORS.is_dir(), reason=f"no reference vectors at {VECTORS}")


def is_installed(module: str) -> bool:
    return importlib.util.find_spec(module) is not None


def cases(name: str) -> list[dict[str, Any]]:
    if not VECTORS.is_dir():
        return []
    loaded: list[dict[str, Any]] = json.loads((VECTORS / f"{name}.json").read_text())
    return [case for case in loaded if case.get("portable", True)]


@cache
def types(name: str) -> dict[str, Any]:
    return dict(load_proto(VECTORS / "protos" / f"{name}.proto"))


@cache
def codec(name: str, type_name: str, strict: bool, passphrase: str | None) -> Codec[Any]:
    return Codec(types(name)[type_name], strict=strict, insecure_passphrase=passphrase)


def check(name: str, case: dict[str, Any]) -> None:
    """One vector, both ways; AssertionError or DcclError where we differ from the library."""
    message_type = types(name)[case["type"]]
    ours = codec(name, case["type"], case.get("strict", False), case.get("passphrase"))
    message = json_format.ParseDict(case["value"], message_type())
    assert (ours.min_size, ours.max_size) == (case["min_size"], case["max_size"])
    if "encode_error" in case:
        with pytest.raises(EncodeError):
            ours.encode(message)
        return
    is_head_only = case.get("header_only", False)
    data = bytes.fromhex(case["hex"])
    assert (ours.encode_head if is_head_only else ours.encode)(message) == data
    now_ns = case.get("decode_clock_unix", NOW_S) * 1_000_000_000
    decoded = (ours.decode_head if is_head_only else ours.decode)(data, now_ns)
    if "decoded" in case:
        assert decoded == json_format.ParseDict(case["decoded"], message_type())
    else:
        # What the library could not read back: a required field that the format loses.
        assert not decoded.IsInitialized()


@pytest.mark.parametrize("name", ["vec2", "vec3", "vec4", "bench"])
def test_the_bytes_are_those_of_the_library_both_ways(name: str) -> None:
    pytest.importorskip("grpc_tools")
    failures, checked = [], 0
    for case in cases(name):
        if case["type"].endswith(".Dyn") and not is_installed("lupa"):
            continue
        if "passphrase" in case and not is_installed("cryptography"):
            continue
        checked += 1
        try:
            check(name, case)
        except Exception as error:
            failures.append(f"{case['name']}: {error!r}")
    assert not failures, f"{len(failures)} of {checked}: " + "; ".join(failures[:5])
    assert checked >= 21


def test_a_strict_codec_encodes_whatever_fits_to_the_same_bytes() -> None:
    pytest.importorskip("grpc_tools")
    same = 0
    for case in cases("bench"):
        message = json_format.ParseDict(case["value"], types("bench")[case["type"]]())
        same += codec("bench", case["type"], True, None).encode(message).hex() == case["hex"]
    assert same == len(cases("bench"))


def arithmetic_models() -> list[ArithmeticModel]:
    """The models with which the arithmetic vectors were written."""
    bell = tuple(1 + math.floor(10000 * math.exp(-0.5 * (i / 8) ** 2)) for i in range(-50, 51))
    return [
        ArithmeticModel("gauss", bell, tuple(range(-50, 52)), eof_frequency=sum(bell) // 20),
        ArithmeticModel("uni8", (1,) * 8, tuple(range(9)), 1, 1),
        ArithmeticModel("adap", (1,) * 6, tuple(range(7)), 1, 0, is_adaptive=True),
    ]


def test_the_arithmetic_codec_writes_and_reads_the_library_s_bits() -> None:
    pytest.importorskip("grpc_tools")
    loaded = types("arith_vec")
    codecs = {
        name: Codec(loaded[name], strict=False, arithmetic_models=arithmetic_models()) for name in loaded
    }
    for case in cases("arith"):
        fields = {name: case[name] for name in ("g", "one", "a", "tail") if name in case}
        message = loaded[case["type"]](**fields)
        data = codecs[case["type"]].encode(message)
        assert data.hex() == case["hex"], case
        decoded = codecs[case["type"]].decode(data)
        if "decoded_g" in case:
            assert list(decoded.g) == case["decoded_g"], case
            one = decoded.one if decoded.HasField("one") else None
            # The library cannot decode an unset `one` (decode_ok is false there); ours can.
            assert one == case.get("decoded_one"), case
        else:
            assert decoded == message, case

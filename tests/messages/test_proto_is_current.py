"""The committed protobuf modules are what the .proto files say."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from messages.proto.straitlink.emergency_stop_pb2 import EmergencyStop
from messages.proto.straitlink.heartbeat_pb2 import Heartbeat

ROOT = Path(__file__).resolve().parents[2]


def test_the_committed_modules_and_stubs_are_regenerated_to_the_byte(tmp_path: Path) -> None:
    pytest.importorskip("grpc_tools")
    generated = subprocess.run(
        [sys.executable, str(ROOT / "tools" / "generate_protobuf.py"), str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert generated.returncode == 0, generated.stderr
    fresh = sorted(tmp_path.rglob("*_pb2.py*"))
    assert len(fresh) == 2 * len(list((ROOT / "messages" / "proto").rglob("*.proto")))
    for path in fresh:
        committed = ROOT / path.relative_to(tmp_path)
        assert committed.read_bytes() == path.read_bytes(), f"run `make proto`: {committed.name} is old"


def test_a_heartbeat_of_zeros_is_as_long_as_any_other() -> None:
    zeros = Heartbeat(capture_ns=0, sequence=0, uptime_s=0, mode=0, battery_ratio=0, padding=bytes(36))
    ones = Heartbeat(
        capture_ns=2**64 - 1, sequence=2**32 - 1, uptime_s=7, mode=4, battery_ratio=0.5, padding=b"x" * 36
    )
    assert len(zeros.SerializeToString()) == len(ones.SerializeToString()) == 64


def test_a_released_emergency_stop_differs_from_an_absent_field() -> None:
    released = EmergencyStop.FromString(EmergencyStop(is_engaged=False).SerializeToString())
    assert released.HasField("is_engaged")
    assert not EmergencyStop.FromString(b"").HasField("is_engaged")

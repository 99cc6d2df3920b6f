"""Joint states from a log cross two real shapers as 45 bytes and are recorded as joint states again."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import pytest
import tomlkit
from mcap.reader import make_reader
from mcap.writer import Writer

from messages.payload.joints import CDR_JOINT_STATE, read_joint_state, write_joint_state
from shaper.traffic_class import DEFAULT_CLASSES
from straitlink.mission import Load, LoadTopic
from straitlink.record import RecordSettings, record
from straitlink.replay import ReplaySettings, replay
from straitlink.schemas import SchemaLibrary, payload_type
from tests.live.processes import Rig, wait_until
from tests.messages.payload.robots import NAMES, sample, write_schema
from tests.mission.scenarios import band, both_ways

pytestmark = pytest.mark.live
MESSAGES = 60
ENOUGH = 40  # on a busy machine newer samples replace some that wait
KEY = "robot/joint_states"
LOAD = Load(
    "joints",
    (
        LoadTopic(KEY, "down", 812, 30, DEFAULT_CLASSES["state"]),
        LoadTopic("operator/command", "up", 80, 1, DEFAULT_CLASSES["command"]),
    ),
)


def write_log(path: Path) -> None:
    """Joint states at 30 Hz."""
    schema = SchemaLibrary().find(payload_type(CDR_JOINT_STATE))
    assert schema is not None
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel(
            f"/{KEY}", "cdr", writer.register_schema(schema.name, schema.encoding, schema.data)
        )
        for step in range(MESSAGES):
            state = sample(step)
            writer.add_message(channel, state.stamp_ns, write_joint_state(state), state.stamp_ns, step)
        writer.finish()


def use_encoding(folder: Path) -> None:
    """Both sides know the robot; only the one that sends names it in a topic."""
    for side in ("robot", "operator"):
        path = folder / f"{side}.toml"
        document = tomlkit.parse(path.read_text())
        document["encodings"] = {"joints": {"proto": "g1.proto"}}
        if side == "robot":
            document["topics"][0]["encoding"] = "joints"  # type: ignore[index]
        path.write_text(tomlkit.dumps(document))


def test_a_replayed_robot_s_joints_are_recorded_on_the_operator_s_side_with_names(tmp_path: Path) -> None:
    log, recorded = tmp_path / "robot.mcap", tmp_path / "operator.mcap"
    write_log(log)
    write_schema(tmp_path)
    with Rig(tmp_path, both_ways(band(60, 1_000_000, 20)), LOAD) as rig:
        use_encoding(tmp_path)
        for name in ("robot", "operator", "link"):
            rig.start(name)
        stop, ready = threading.Event(), threading.Event()
        settings = RecordSettings(recorded, rig.bus("operator"), stop=stop, on_ready=ready.set)
        recorder = threading.Thread(target=record, args=(settings,))
        recorder.start()
        try:
            assert ready.wait(5)
            replay(ReplaySettings(log, rig.bus("robot")))
            wait_until(lambda: len(deliveries(rig)) >= ENOUGH)
        finally:
            stop.set()
            recorder.join()
    with recorded.open("rb") as stream:
        got = list(make_reader(stream).iter_messages(topics=f"/{KEY}"))
    assert len(got) >= ENOUGH
    sent = {sample(step).stamp_ns: sample(step) for step in range(MESSAGES)}
    for schema, channel, message in got:
        assert schema is not None
        assert (schema.name, channel.message_encoding) == ("sensor_msgs/msg/JointState", "cdr")
        state = read_joint_state(message.data)
        assert state.names == NAMES
        assert state.positions == pytest.approx(sent[state.stamp_ns].positions, abs=0.001)
    assert {len(message.data) for _, _, message in got} == {812}
    (*_, ledger) = [r["topics"] for r in rig.records("robot") if r["event"] == "ledger"]
    assert ledger[KEY]["sent_bytes"] == 45 * ledger[KEY]["sent"]


def deliveries(rig: Rig) -> list[dict[str, Any]]:
    """What the operator's side has delivered, by its trace."""
    return [r for r in rig.records("operator") if r["event"] == "delivered" and r["topic"] == KEY]

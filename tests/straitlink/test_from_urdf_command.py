"""`straitlink messages from-urdf`: a .proto from a URDF, and sentences for what is wrong."""

from __future__ import annotations

from pathlib import Path

import pytest
from mcap.writer import Writer
from typer.testing import CliRunner

from messages.dccl import Codec, load_proto, sendable_types
from messages.payload import PayloadError
from messages.payload.joints import JointSample, write_joint_state
from messages.urdf import UrdfError
from straitlink.cli import app
from tests.messages.test_from_urdf import ARM


def run(*arguments: str) -> str:
    result = CliRunner().invoke(app, ["messages", "from-urdf", *arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


@pytest.fixture
def urdf(tmp_path: Path) -> str:
    path = tmp_path / "arm.urdf"
    path.write_bytes(ARM)
    return str(path)


def write_log(path: Path, names: tuple[str, ...]) -> None:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema("sensor_msgs/msg/JointState", "ros2msg", b"")
        other = writer.register_channel("/other", "json", 0)
        joints = writer.register_channel("/joint_states", "cdr", schema)
        writer.add_message(other, 1, b"{}", 1)
        if names:
            state = JointSample(5, names, dict.fromkeys(names, 0.1), {}, {})
            writer.add_message(joints, 2, write_joint_state(state), 2)
        writer.finish()


def test_the_file_is_printed_or_written_with_its_budget(urdf: str, tmp_path: Path) -> None:
    printed = run(urdf, "--bits", "12")
    out = tmp_path / "arm.proto"
    budget = run(urdf, "--bits", "12", "-o", str(out))
    assert out.read_text() == printed
    assert "arm_1.JointStates" in budget and "total 6..12 bytes" in budget
    (message_type,) = sendable_types(load_proto(out)).values()
    assert Codec(message_type).info().max_bytes == 12


def test_a_log_says_which_joints_are_told_and_in_which_order(urdf: str, tmp_path: Path) -> None:
    write_log(tmp_path / "log.mcap", ("lift", "shoulder/pan joint"))
    text = run(urdf, "--joints-from", str(tmp_path / "log.mcap"))
    fields = [line for line in text.splitlines() if "json_name" in line]
    assert [line.split()[2] for line in fields] == ["lift", "shoulder_pan_joint"]


@pytest.mark.parametrize(
    ("names", "topic", "reason"),
    [
        (("tail",), None, "has no movable joint 'tail'"),
        ((), None, "has no joint states"),
        (("lift",), "/other", "topic /other: has no joint states"),
    ],
)
def test_a_log_that_does_not_go_with_the_robot_is_told(
    urdf: str, tmp_path: Path, names: tuple[str, ...], topic: str | None, reason: str
) -> None:
    write_log(tmp_path / "log.mcap", names)
    arguments = [urdf, "--joints-from", str(tmp_path / "log.mcap"), *(["--topic", topic] if topic else [])]
    with pytest.raises((UrdfError, PayloadError), match=reason):
        run(*arguments)


@pytest.mark.parametrize(
    ("content", "options", "reason"),
    [
        (b"<sdf/>", [], r"arm.urdf: the outermost element is <sdf>"),
        (ARM, ["--bits", "99"], "bits = 99 is not within 2..32"),
        (ARM.replace(b'velocity="20" ', b""), ["--velocity-bits", "8"], "'wheel' states no velocity limit"),
    ],
)
def test_a_mistake_is_told_with_the_file_s_name(
    urdf: str, content: bytes, options: list[str], reason: str
) -> None:
    Path(urdf).write_bytes(content)
    with pytest.raises(UrdfError, match=reason):
        run(urdf, *options)

"""A URDF becomes a .proto whose joints have their own limits, whatever their names and kinds."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from messages.dccl import Codec, load_proto, sendable_types
from messages.from_urdf import Detail, proto_of
from messages.urdf import Joint, Robot, UrdfError, parse_urdf

ARM = b"""<?xml version="1.0"?>
<robot name="arm-1">
  <joint name="shoulder/pan joint" type="revolute"><limit lower="-1.57" upper="2" velocity="3" effort="10"/></joint>
  <joint name="wheel" type="continuous"><limit velocity="20" effort="5"/></joint>
  <joint name="lift" type="prismatic"><limit lower="0" upper="0.5" velocity="1" effort="100"/></joint>
  <joint name="weld" type="fixed"/>
  <joint name="knee" type="revolute"><mimic joint="lift"/><limit upper="2" velocity="3" effort="10"/></joint>
</robot>"""


def codec_of(text: str, folder: Path) -> Codec:  # type: ignore[type-arg]
    path = folder / "robot.proto"
    path.write_text(text)
    (message_type,) = sendable_types(load_proto(path)).values()
    return Codec(message_type)


def test_the_movable_joints_are_read_with_their_limits() -> None:
    robot = parse_urdf(ARM)
    assert robot == Robot(
        "arm-1",
        (
            Joint("shoulder/pan joint", "revolute", -1.57, 2, 3, 10),
            Joint("wheel", "continuous", -math.pi, math.pi, 20, 5),
            Joint("lift", "prismatic", 0, 0.5, 1, 100),
            Joint("knee", "revolute", 0, 2, 3, 10),
        ),
    )


@pytest.mark.parametrize(
    ("urdf", "reason"),
    [
        (b"<robot", "not XML"),
        (b"<sdf/>", "not <robot>"),
        (b"<robot/>", "no movable joint"),
        (b"<!DOCTYPE lolz []><robot/>", "document type"),
        (b"<robot><joint name='k' type='revolute'/></robot>", "'k' is revolute but states no limits"),
        (b"<robot><joint name='k' type='revolute'><limit lower='2' upper='1'/></joint></robot>", "above upper = 1"),
        (b"<robot><joint name='k' type='revolute'><limit upper='2,5'/></joint></robot>", "upper = '2,5'"),
        (b"<robot><joint name='k' type='revolute'><limit upper='inf'/></joint></robot>", "upper = 'inf'"),
        (b"<robot><joint name='[k]' type='continuous'/></robot>", "not start with"),
        (b"<robot><joint type='continuous'/></robot>", "no name"),
        (b"<robot>" + b"<joint name='k' type='continuous'/>" * 2 + b"</robot>", "'k' is there more than once"),
        (b"<robot xmlns:xacro='http://x.org/xacro'><xacro:arm/></robot>", "expand it"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_urdf_is_said(urdf: bytes, reason: str) -> None:
    with pytest.raises(UrdfError, match=reason):
        parse_urdf(urdf)


def test_the_schema_has_a_field_with_name_unit_and_bounds_for_each_joint(tmp_path: Path) -> None:
    codec = codec_of(proto_of(parse_urdf(ARM), Detail(velocity_bits=8, effort_bits=8), "arm.urdf"), tmp_path)
    rows = {row.path: row for row in codec.info().fields}
    pan = rows["positions.shoulder_pan_joint"]
    assert (pan.minimum, pan.maximum, pan.resolution, pan.unit) == (-1.57, 2, 0.001, "rad")
    lift = rows["positions.lift"]
    assert (lift.minimum, lift.maximum, lift.resolution, lift.unit) == (0, 0.5, 0.0005, "m")
    assert (rows["velocities.wheel"].unit, rows["efforts.lift"].unit) == ("rad/s", "N")
    assert rows["velocities.wheel"].max_bits == rows["efforts.wheel"].max_bits == 8
    fields = codec.message_type.DESCRIPTOR.fields_by_name["positions"].message_type.fields
    assert [f.json_name for f in fields] == ["shoulder/pan joint", "wheel", "lift", "knee"]


def test_chosen_joints_come_in_the_order_that_was_asked_for(tmp_path: Path) -> None:
    text = proto_of(parse_urdf(ARM), Detail(has_stamp=False), "arm.urdf", ["knee", "lift"])
    fields = codec_of(text, tmp_path).message_type.DESCRIPTOR.fields_by_name["positions"].message_type.fields
    assert [f.name for f in fields] == ["knee", "lift"]


@st.composite
def robots(draw: st.DrawFn) -> Robot:
    letters = st.characters(exclude_categories=("C", "Z"), exclude_characters="[")
    names = draw(st.lists(st.text(letters, min_size=1, max_size=8), min_size=1, max_size=4, unique=True))
    joints = []
    for name in names:
        lower = draw(st.floats(-1000, 1000).map(lambda x: round(x, 6)))
        span = draw(st.sampled_from([0, 1e-6, 0.002, 1, math.pi, 2000]))
        kind = draw(st.sampled_from(["revolute", "prismatic"]))
        joints.append(Joint(name, kind, lower, lower + span, 5.0, 7.0))
    return Robot(draw(st.text(letters, max_size=5)), tuple(joints))


@settings(max_examples=8, deadline=None)
@given(robots(), st.integers(2, 24), st.booleans())
def test_any_robot_s_schema_loads_and_costs_just_the_bits_asked_for(
    tmp_path_factory: pytest.TempPathFactory, robot: Robot, bits: int, has_stamp: bool
) -> None:
    text = proto_of(robot, Detail(bits=bits, has_stamp=has_stamp), "any\nfile")
    codec = codec_of(text, tmp_path_factory.mktemp("robot"))
    info = codec.info()
    rows = [row for row in info.fields if row.path.startswith("positions.")]
    for row, joint in zip(rows, robot.joints, strict=True):
        assert row.minimum is not None and row.maximum is not None and row.resolution is not None
        assert row.minimum <= joint.lower <= joint.upper <= row.maximum
        assert row.max_bits == bits or (joint.lower == joint.upper and row.max_bits <= bits)
        finest = max(joint.upper - joint.lower, 1e-6) / ((1 << bits) - 2)
        assert row.resolution <= finest * 1.002 if bits > 11 else row.resolution <= 4 * finest
    assert info.max_bytes == info.max_bytes_allowed


@pytest.mark.parametrize(
    ("detail", "reason"),
    [({"bits": 1}, "bits = 1"), ({"resolution_rad": 0}, "resolution_rad = 0"), ({"margin_ratio": -1}, "margin_ratio")],
)  # fmt: skip
def test_a_detail_that_cannot_be_is_refused(detail: dict[str, float], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        Detail(**detail)  # type: ignore[arg-type]


@pytest.mark.parametrize("magnitude", ["0", "inf", "1e9", "", "as needed", "nan"])
def test_a_velocity_that_limits_nothing_is_no_fault_unless_it_is_asked_for(magnitude: str) -> None:
    text = f"<robot><joint name='a' type='revolute'><limit lower='-1' upper='1' velocity='{magnitude}'/>"
    robot = parse_urdf(f"{text}</joint></robot>".encode())
    assert "positions" in proto_of(robot, Detail(), "a.urdf")
    with pytest.raises(ValueError, match="joint 'a' states no velocity limit within 0 and 1e6"):
        proto_of(robot, Detail(velocity_bits=8), "a.urdf")

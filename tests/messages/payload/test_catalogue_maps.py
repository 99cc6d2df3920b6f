"""What a bus says in Foxglove's, ROS 2's or our own types crosses bounded and is the same on the other side."""

from __future__ import annotations

import contextlib
import math
from functools import cache
from typing import TypeVar

import pytest
from foxglove_schemas_protobuf.ArrowPrimitive_pb2 import ArrowPrimitive
from foxglove_schemas_protobuf.KeyValuePair_pb2 import KeyValuePair
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from hypothesis import given
from hypothesis import strategies as st

from messages.bounded_catalogue import BOUNDED_CATALOGUE, find_bounded
from messages.payload import Payload, PayloadError
from messages.payload.bounded import BoundedEncoding
from messages.payload.joints import FORMS, JointSample
from messages.payload.maps import maps_of
from messages.payload.plan_maps import (
    FOOTSTEP_FORMS,
    TRAJECTORY_FORMS,
    Trajectory,
    quaternion,
    roll_pitch_yaw,
)
from messages.payload.poses import (
    HAND_FORMS,
    ODOMETRY_FORMS,
    TRANSFORM_FORMS,
    WRENCH_FORMS,
    ForceTorque,
    Four,
    FramePose,
    Hands,
    Motion,
)
from messages.payload.value_map import Forms
from messages.proto.straitlink.bounded.joint_command_pb2 import JointCommand
from messages.proto.straitlink.bounded.pivot_plan_pb2 import PivotPlan
from messages.proto.straitlink.emergency_stop_pb2 import EmergencyStop
from messages.proto.straitlink.footstep_plan_pb2 import FootstepPlan
from messages.proto.straitlink.heartbeat_pb2 import Heartbeat

FOXGLOVE_SCENE = "application/protobuf;foxglove.SceneUpdate"
CAPTURE_NS = 1_750_000_000_123_456_789
LIMIT = 1_000_000
V = TypeVar("V")
MAPPED = [(message.name, m.bus_type) for message in BOUNDED_CATALOGUE for m in maps_of(message.message_type)]


@cache
def encoding(name: str) -> BoundedEncoding:
    found = find_bounded(name)
    assert found is not None
    return BoundedEncoding(found.message_type, maps_of(found.message_type))


def crossed(name: str, forms: Forms[V], form: str, value: V) -> tuple[V, int]:
    """What comes out on the other side in the same form, and how many bytes it took."""
    read, write = forms[form]
    data = encoding(name).encode(Payload(write(value), form)).data
    payload = encoding(name).decode(data, form, LIMIT, CAPTURE_NS)
    assert payload.type == form
    return read(payload.data), len(data)


def angle_between(a: Four, b: Four) -> float:
    return 2 * math.acos(min(1.0, abs(sum(x * y for x, y in zip(a, b, strict=True)))))


TURNED = quaternion(0.1, -0.2, 2.5)


@pytest.mark.parametrize("form", ODOMETRY_FORMS)
def test_odometry(form: str) -> None:
    pose = FramePose("odom", "base_link", (12.344, -7.891, 0.93), TURNED, 5)
    after, size = crossed(
        "straitlink.bounded.Odometry", ODOMETRY_FORMS, form, Motion(pose, (0.5, 0, 0), (0, 0, -1))
    )
    assert size == 21
    assert (after.pose.parent, after.pose.child, after.pose.stamp_ns) == ("odom", "base_link", CAPTURE_NS)
    assert after.pose.position == pytest.approx(pose.position, abs=0.005)
    assert angle_between(after.pose.orientation, TURNED) < 0.003
    assert after.linear == pytest.approx((0.5, 0, 0)) and after.angular == pytest.approx((0, 0, -1))


def test_odometry_without_velocities_is_smaller_and_stays_without_them() -> None:
    form = next(iter(ODOMETRY_FORMS))
    motion = Motion(FramePose("odom", "base_link", (0, 0, 0), TURNED), None, None)
    after, size = crossed("straitlink.bounded.Odometry", ODOMETRY_FORMS, form, motion)
    assert (after.linear, after.angular, size) == (None, None, 13)


@pytest.mark.parametrize("form", TRANSFORM_FORMS)
def test_frame_transforms(form: str) -> None:
    poses = (
        FramePose("map", "odom", (1, 2, 0), (0, 0, 0, 1)),
        FramePose("head", "head_camera_optical_frame", (0.08, 0.035, 0), TURNED),
    )
    after, size = crossed("straitlink.bounded.FrameTransforms", TRANSFORM_FORMS, form, poses)
    assert [(p.parent, p.child) for p in after] == [(p.parent, p.child) for p in poses]
    for before, now in zip(poses, after, strict=True):
        assert now.position == pytest.approx(before.position, abs=0.0051)
        assert angle_between(now.orientation, before.orientation) < 0.003
    assert size < 30


@pytest.mark.parametrize("form", HAND_FORMS)
def test_hand_poses(form: str) -> None:
    hands = Hands("tracker", 0, ((0.3004, 0.2, 1.1), TURNED), ((0.3, -0.2, 1.1), (0, 0, 0, 1)))
    after, size = crossed("straitlink.bounded.HandPoses", HAND_FORMS, form, hands)
    assert size == 21
    for before, now in ((hands.left, after.left), (hands.right, after.right)):
        assert now[0] == pytest.approx(before[0], abs=0.0005001)
        assert angle_between(now[1], before[1]) < 0.003


@pytest.mark.parametrize("form", WRENCH_FORMS)
def test_wrench(form: str) -> None:
    value = ForceTorque("l_foot", 0, (10.2, -5.1, 812.4), (3.14, -20, 0.5))
    after, size = crossed("straitlink.bounded.Wrench", WRENCH_FORMS, form, value)
    assert (after.frame, after.stamp_ns, size) == ("l_foot", CAPTURE_NS, 18)
    assert after.force == pytest.approx(value.force, abs=0.251)
    assert after.torque == pytest.approx(value.torque, abs=0.051)


@pytest.mark.parametrize("form", TRAJECTORY_FORMS)
def test_motion_plan(form: str) -> None:
    names = ("l_arm_shz", "l_arm_shx", "l_arm_ely")
    plan = Trajectory(7, 0, names, tuple((i * 250_000_000, (0.1 * i, -0.1 * i, 0.2 * i)) for i in range(6)))
    after, size = crossed("straitlink.bounded.MotionPlan", TRAJECTORY_FORMS, form, plan)
    told = {name: i for i, name in enumerate(after.names)}
    assert set(told) == set(names) and len(after.knots) == 6
    for (time_ns, positions), (now_ns, now) in zip(plan.knots, after.knots, strict=True):
        assert now_ns == time_ns
        assert [now[told[name]] for name in names] == pytest.approx(positions, abs=0.00251)
    assert size < 60


def test_footstep_plan() -> None:
    (form,) = FOOTSTEP_FORMS
    plan = FootstepPlan(plan_id=65_537, frame_id="odom")
    for i in range(8):
        step = plan.footsteps.add(foot=1 + i % 2, is_locked=i == 0, is_final=i == 7, swing_height_m=0.2, duration_s=0.9)  # fmt: skip
        step.pose.position.x, step.pose.position.y, step.pose.position.z = 0.3 * i, 0.1, 0.05 * i
        o = step.pose.orientation
        o.x, o.y, o.z, o.w = quaternion(0, 0.1, 0.2 * i)
    after, size = crossed("straitlink.bounded.FootstepPlan", FOOTSTEP_FORMS, form, plan)
    assert (after.plan_id, after.frame_id, after.capture_ns) == (1, "odom", CAPTURE_NS)
    assert size == 97
    for before, now in zip(plan.footsteps, after.footsteps, strict=True):
        assert (now.foot, now.is_final, now.is_locked) == (before.foot, before.is_final, before.is_locked)
        assert now.pose.position.x == pytest.approx(before.pose.position.x, abs=0.00501)
        assert (now.swing_height_m, now.duration_s) == pytest.approx((0.2, 0.9))
        b, n = before.pose.orientation, now.pose.orientation
        assert angle_between((b.x, b.y, b.z, b.w), (n.x, n.y, n.z, n.w)) < 0.01


@pytest.mark.parametrize("form", FORMS)
def test_a_joint_command_crosses_as_joint_states_by_name(form: str) -> None:
    names = tuple(f.name for f in JointCommand.Positions.DESCRIPTOR.fields)
    command = JointSample(0, names[:12], dict.fromkeys(names[:12], -0.1), {}, {})
    after, size = crossed("straitlink.bounded.JointCommand", FORMS, form, command)
    assert (after.names, after.stamp_ns, size) == (names[:12], CAPTURE_NS, 36)
    assert after.positions == pytest.approx(command.positions)


def test_messages_that_are_on_the_bus_as_they_are_cross_bit_packed_and_get_the_link_s_capture_time() -> None:
    beat = Heartbeat(
        capture_ns=1, sequence=2**32 - 1, uptime_s=77, mode=2, battery_ratio=0.5, padding=bytes(36)
    )
    stop = EmergencyStop(capture_ns=1, sequence=3, is_engaged=False, reason=1)
    for message, size in ((beat, 11), (stop, 6)):
        name = message.DESCRIPTOR.full_name
        form = f"application/protobuf;{name}"
        data = encoding(name).encode(Payload(message.SerializeToString(), form)).data
        assert len(data) == size
        after = type(message).FromString(encoding(name).decode(data, form, LIMIT, CAPTURE_NS).data)
        assert after.capture_ns == CAPTURE_NS
        message.ClearField("capture_ns")
        after.ClearField("capture_ns")
        if isinstance(message, Heartbeat):
            message.ClearField("padding")
        assert after == message


def test_a_released_emergency_stop_is_still_told_from_an_absent_field() -> None:
    name = EmergencyStop.DESCRIPTOR.full_name
    form = f"application/protobuf;{name}"
    data = encoding(name).encode(Payload(EmergencyStop(is_engaged=False).SerializeToString(), form)).data
    after = EmergencyStop.FromString(encoding(name).decode(data, form, LIMIT, None).data)
    assert after.HasField("is_engaged") and not after.is_engaged and not after.HasField("reason")


@pytest.mark.parametrize(
    ("steps", "reason"),
    [
        ([("A", 10), ("B", 35)], "turns a pivot plan by 25 deg, beyond 22.5"),
        ([("A", 10), ("A", 5)], "stays on the corner"),
        ([("A", 20), ("B", 40), ("A", 60)], "60 is not a value within its bounds -45 to 45"),
    ],
)
def test_a_pivot_plan_that_would_tip_the_object_is_refused(
    steps: list[tuple[str, float]], reason: str
) -> None:
    name = PivotPlan.DESCRIPTOR.full_name
    plan = PivotPlan(plan_id=1, width=0.8, depth=0.5, height=1.2)
    for corner, angle in steps:
        plan.steps.add(corner=PivotPlan.Corner.Value(corner), angle=angle)
    with pytest.raises(PayloadError, match=reason):
        encoding(name).encode(Payload(plan.SerializeToString(), f"application/protobuf;{name}"))


def scene(**changes: object) -> SceneUpdate:
    pair = KeyValuePair
    valve = SceneEntity(id="affordance/7", frame_id="base_link", arrows=[ArrowPrimitive()])
    valve.metadata.extend([pair(key="parameter_0", value="0.25"), pair(key="template_id", value="3")])
    valve.metadata.add(key="parameter_1", value="-1.5")
    valve.arrows[0].pose.position.x, valve.arrows[0].pose.orientation.w = 0.8, 2 * 0.7
    for field, value in changes.items():
        valve.ClearField(field)  # type: ignore[arg-type]
        valve.MergeFrom(SceneEntity(**{field: value}))  # type: ignore[arg-type]
    return SceneUpdate(entities=[valve])


def test_an_affordance_is_an_arrow_in_foxglove_s_scene() -> None:
    name = "straitlink.bounded.Affordance"
    data = encoding(name).encode(Payload(scene().SerializeToString(), FOXGLOVE_SCENE)).data
    assert len(data) <= 18
    payload = encoding(name).decode(data, FOXGLOVE_SCENE, LIMIT, CAPTURE_NS)
    (valve,) = SceneUpdate.FromString(payload.data).entities
    told = {pair.key: pair.value for pair in valve.metadata}
    assert told == {"template_id": "3", "parameter_0": "0.25", "parameter_1": "-1.5"}
    assert (valve.id, valve.frame_id) == ("affordance/7", "base_link")
    pose = valve.arrows[0].pose
    assert (pose.position.x, pose.orientation.w) == (pytest.approx(0.8), 1)
    assert encoding(name).encode(payload).data == data


@pytest.mark.parametrize(
    ("sent", "reason"),
    [
        (SceneUpdate(), "0 entities and 0 deletions is not one affordance"),
        (scene(id="valve"), "id = 'valve' is not a number"),
        (scene(id="affordance/999"), "affordance_id = 999 is not a value within its bounds 0 to 255"),
        (scene(frame_id="map"), "frame_id = 'map' is not 'base_link'"),
        (scene(arrows=[]), "has 0 arrows"),
        (scene(arrows=[ArrowPrimitive()]), "no orientation"),
        (scene(metadata=[]), "template_id = '' is not a number"),
        (scene(metadata=[KeyValuePair(key="colour", value="red")]), "template_id"),
        (
            scene(metadata=[KeyValuePair(key=k, value="1") for k in ("template_id", "colour")]),
            r"\['colour'\] lack parameter_0",
        ),
        (
            scene(metadata=[KeyValuePair(key="template_id", value="1"), KeyValuePair(key="parameter_0", value="x")]),
            "parameter_0 = 'x' is not a number",
        ),
    ],
)  # fmt: skip
def test_a_scene_that_is_no_affordance_is_refused(sent: SceneUpdate, reason: str) -> None:
    with pytest.raises(PayloadError, match=reason):
        encoding("straitlink.bounded.Affordance").encode(Payload(sent.SerializeToString(), FOXGLOVE_SCENE))


@pytest.mark.parametrize(
    ("name", "forms", "value", "reason"),
    [
        ("Odometry", ODOMETRY_FORMS, Motion(FramePose("map", "base_link", (0, 0, 0), TURNED), None, None), "not of 'base_link' in 'map'"),
        ("Odometry", ODOMETRY_FORMS, Motion(FramePose("odom", "base_link", (2000, 0, 0), TURNED), None, None), "pose.x = 2000"),
        ("FrameTransforms", TRANSFORM_FORMS, (FramePose("map", "tail", (0, 0, 0), TURNED),), "no frame 'tail'"),
        ("MotionPlan", TRAJECTORY_FORMS, Trajectory(0, 0, ("tail",), ((0, (0.0,)),)), "no joint 'tail'"),
        ("Wrench", WRENCH_FORMS, ForceTorque("f", 0, (math.nan, 0, 0), (0, 0, 0)), "force.x"),
    ],
)  # fmt: skip
def test_what_a_bounded_message_cannot_say_is_refused(
    name: str, forms: Forms[object], value: object, reason: str
) -> None:
    for form, (_, write) in forms.items():
        with pytest.raises(PayloadError, match=reason):
            encoding(f"straitlink.bounded.{name}").encode(Payload(write(value), form))


def test_a_quaternion_without_length_is_no_orientation() -> None:
    form = next(iter(ODOMETRY_FORMS))
    payload = ODOMETRY_FORMS[form][1](
        Motion(FramePose("odom", "base_link", (0, 0, 0), (0, 0, 0, 0)), None, None)
    )
    with pytest.raises(PayloadError, match="is no orientation"):
        encoding("straitlink.bounded.Odometry").encode(Payload(payload, form))


@pytest.mark.parametrize(("name", "form"), MAPPED)
@given(data=st.binary(max_size=200))
def test_any_payload_of_any_form_is_encoded_or_refused_and_any_bytes_are_read_or_refused(
    name: str, form: str, data: bytes
) -> None:
    with contextlib.suppress(PayloadError):
        encoding(name).encode(Payload(data, form))
    with contextlib.suppress(PayloadError):
        encoding(name).decode(data[:60], form, LIMIT, CAPTURE_NS)


@given(st.floats(-3, 3), st.floats(-1.5, 1.5), st.floats(-3, 3))
def test_angles_and_quaternions_say_the_same(roll: float, pitch: float, yaw: float) -> None:
    again = quaternion(*roll_pitch_yaw(quaternion(roll, pitch, yaw)))
    assert angle_between(again, quaternion(roll, pitch, yaw)) < 1e-6

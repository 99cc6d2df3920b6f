"""Plans of a bus as messages of the catalogue, and back.

Time stamps do not cross: the link's capture time of the message stands in for them. Plan numbers are
told modulo 2^16.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from messages.payload.joint_maps import joint_names
from messages.payload.poses import Four, unit
from messages.payload.protobuf import parse, protobuf
from messages.payload.ros import NS_PER_S, cdr, read_cdr, ros_class, ros_header, stamp_ns_of, write_cdr
from messages.payload.topic_encoding import PayloadError
from messages.payload.value_map import Forms, maps_of_forms
from messages.proto.straitlink import footstep_plan_pb2, motion_plan_pb2
from messages.proto.straitlink.bounded.footstep_plan_pb2 import FootstepPlan
from messages.proto.straitlink.bounded.motion_plan_pb2 import MotionPlan

_TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
_PLAN_IDS = 1 << 16


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Joint positions (rad) over time. knots: (ns from the start, one position for each name)."""

    plan_id: int
    stamp_ns: int
    names: tuple[str, ...]
    knots: tuple[tuple[int, tuple[float, ...]], ...]


def read_motion_plan(payload: bytes) -> Trajectory:
    """straitlink.MotionPlan."""
    message = parse(motion_plan_pb2.MotionPlan, payload)
    knots = [(knot.time_from_start_ns, tuple(knot.positions_rad)) for knot in message.knot_points]
    return _checked(Trajectory(message.plan_id, message.capture_ns, tuple(message.joint_names), tuple(knots)))


def write_motion_plan(plan: Trajectory) -> bytes:
    """straitlink.MotionPlan."""
    message = motion_plan_pb2.MotionPlan(
        capture_ns=max(0, plan.stamp_ns), plan_id=plan.plan_id, joint_names=plan.names
    )
    for time_ns, positions in plan.knots:
        message.knot_points.add(time_from_start_ns=time_ns, positions_rad=positions)
    return message.SerializeToString()


def read_trajectory(payload: bytes) -> Trajectory:
    """trajectory_msgs/JointTrajectory; velocities, accelerations and efforts are left out."""
    message = read_cdr(payload, _TRAJECTORY)
    knots = [
        (p.time_from_start.sec * NS_PER_S + p.time_from_start.nanosec, tuple(map(float, p.positions)))
        for p in message.points
    ]
    return _checked(Trajectory(0, stamp_ns_of(message.header), tuple(message.joint_names), tuple(knots)))


def write_trajectory(plan: Trajectory) -> bytes:
    """trajectory_msgs/JointTrajectory."""
    none = np.zeros(0)
    points = [
        ros_class("trajectory_msgs/msg/JointTrajectoryPoint")(
            np.array(positions),
            none,
            none,
            none,
            ros_class("builtin_interfaces/msg/Duration")(*divmod(time_ns, NS_PER_S)),
        )
        for time_ns, positions in plan.knots
    ]
    message = ros_class(_TRAJECTORY)(ros_header(plan.stamp_ns), list(plan.names), points)
    return write_cdr(message, _TRAJECTORY)


TRAJECTORY_FORMS: Forms[Trajectory] = {
    protobuf(motion_plan_pb2.MotionPlan): (read_motion_plan, write_motion_plan),
    cdr(_TRAJECTORY): (read_trajectory, write_trajectory),
}


def motion_plan_of(plan: Trajectory) -> MotionPlan:
    """The bounded message. Raises PayloadError for a joint that it has no field for."""
    fields = joint_names(MotionPlan.Positions)
    message = MotionPlan(plan_id=plan.plan_id % _PLAN_IDS)
    for time_ns, positions in plan.knots:
        knot = message.knots.add(time_from_start=time_ns / NS_PER_S)
        knot.positions.SetInParent()
        for name, position in zip(plan.names, positions, strict=True):
            if name not in fields:
                raise PayloadError(f"straitlink.bounded.MotionPlan has no joint {name!r}")
            setattr(knot.positions, fields[name], position)
    return message


def trajectory_of(message: MotionPlan, capture_unix_ns: int | None) -> Trajectory:
    """What a bounded message says. Raises PayloadError where its knots do not tell the same joints."""
    fields = joint_names(MotionPlan.Positions)
    names: tuple[str, ...] = ()
    knots = []
    for number, knot in enumerate(message.knots):
        told = {name: field for name, field in fields.items() if _has(knot.positions, field)}
        names = tuple(told) if number == 0 else names
        if names != tuple(told):
            raise PayloadError(f"knot {number} of a motion plan tells other joints than knot 0")
        positions = tuple(getattr(knot.positions, field) for field in told.values())
        knots.append((round(knot.time_from_start * NS_PER_S), positions))
    return Trajectory(message.plan_id, capture_unix_ns or 0, names, tuple(knots))


def _has(message: Any, field: str) -> bool:
    return bool(message.HasField(field))


def _checked(plan: Trajectory) -> Trajectory:
    if len(set(plan.names)) != len(plan.names):
        raise PayloadError("a trajectory names a joint more than once")
    for number, (_, positions) in enumerate(plan.knots):
        if len(positions) != len(plan.names):
            raise PayloadError(
                f"knot {number} has {len(positions)} positions for {len(plan.names)} joints of a trajectory"
            )
    return plan


def _read_footsteps(payload: bytes) -> footstep_plan_pb2.FootstepPlan:
    return parse(footstep_plan_pb2.FootstepPlan, payload)


def _write_footsteps(plan: footstep_plan_pb2.FootstepPlan) -> bytes:
    return plan.SerializeToString()


def footsteps_of(plan: footstep_plan_pb2.FootstepPlan) -> FootstepPlan:
    """The bounded message. Raises PayloadError for other frames than map and odom."""
    if plan.frame_id not in ("map", "odom"):
        raise PayloadError(f"straitlink.bounded.FootstepPlan is in map or odom, not in {plan.frame_id!r}")
    message = FootstepPlan(
        plan_id=plan.plan_id % _PLAN_IDS, frame=FootstepPlan.Frame.Value(plan.frame_id.upper())
    )
    for step in plan.footsteps:
        at, turned = step.pose.position, step.pose.orientation
        roll, pitch, yaw = roll_pitch_yaw(unit((turned.x, turned.y, turned.z, turned.w)))
        try:
            message.footsteps.add(
                foot=FootstepPlan.Foot.ValueType(step.foot),
                x=at.x,
                y=at.y,
                z=at.z,
                roll=roll,
                pitch=pitch,
                yaw=yaw,
                swing_height=step.swing_height_m,
                duration=step.duration_s,
                is_final=step.is_final,
                is_locked=step.is_locked,
            )
        except ValueError as error:
            raise PayloadError(f"a footstep plan's foot {step.foot} is none: {error}") from error
    return message


def footstep_plan_of(message: Any, capture_unix_ns: int | None) -> footstep_plan_pb2.FootstepPlan:
    """What a bounded message says."""
    plan = footstep_plan_pb2.FootstepPlan(
        capture_ns=max(0, capture_unix_ns or 0),
        plan_id=message.plan_id,
        frame_id=FootstepPlan.Frame.Name(message.frame).lower(),
    )
    for step in message.footsteps:
        added = plan.footsteps.add(
            foot=footstep_plan_pb2.FootstepPlan.Foot.ValueType(step.foot),
            is_final=step.is_final,
            is_locked=step.is_locked,
            swing_height_m=step.swing_height,
            duration_s=step.duration,
        )
        position, orientation = added.pose.position, added.pose.orientation
        position.x, position.y, position.z = step.x, step.y, step.z
        turned = quaternion(step.roll, step.pitch, step.yaw)
        orientation.x, orientation.y, orientation.z, orientation.w = turned
    return plan


FOOTSTEP_FORMS: Forms[footstep_plan_pb2.FootstepPlan] = {
    protobuf(footstep_plan_pb2.FootstepPlan): (_read_footsteps, _write_footsteps)
}


def roll_pitch_yaw(orientation: Four) -> tuple[float, float, float]:
    """Angles about the fixed axes x, y, z, in this order (REP-103)."""
    x, y, z, w = orientation
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    return roll, pitch, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def quaternion(roll: float, pitch: float, yaw: float) -> Four:
    """The inverse of roll_pitch_yaw."""
    (sr, cr), (sp, cp), (sy, cy) = ((math.sin(a / 2), math.cos(a / 2)) for a in (roll, pitch, yaw))
    return (
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
        cr * cp * cy + sr * sp * sy,
    )


MOTION_PLAN_MAPS = maps_of_forms(TRAJECTORY_FORMS, "trajectory", motion_plan_of, trajectory_of)
FOOTSTEP_PLAN_MAPS = maps_of_forms(FOOTSTEP_FORMS, "footsteps", footsteps_of, footstep_plan_of)

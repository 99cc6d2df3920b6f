"""Poses, motions and forces of a bus as messages of the catalogue, and back.

Time stamps do not cross: the link's capture time of the message stands in for them.
"""

from __future__ import annotations

from typing import Any

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
    Three,
    unit,
    xyz,
)
from messages.payload.topic_encoding import PayloadError
from messages.payload.value_map import maps_of_forms
from messages.proto.straitlink.bounded.frame_transforms_pb2 import FrameTransforms
from messages.proto.straitlink.bounded.geometry_pb2 import MapPose, Quaternion
from messages.proto.straitlink.bounded.hand_poses_pb2 import HandPoses
from messages.proto.straitlink.bounded.odometry_pb2 import Odometry
from messages.proto.straitlink.bounded.wrench_pb2 import Wrench

_PARENT, _CHILD, _TRACKER = "odom", "base_link", "tracker"


def _quaternion(values: Four) -> Quaternion:
    x, y, z, w = values
    return Quaternion(x=x, y=y, z=z, w=w)


def _map_pose(pose: FramePose) -> MapPose:
    x, y, z = pose.position
    return MapPose(x=x, y=y, z=z, orientation=_quaternion(pose.orientation))


def _orientation(message: Any) -> Four:
    return unit((message.x, message.y, message.z, message.w))


def odometry_of(motion: Motion) -> Odometry:
    """The bounded message. Raises PayloadError for other frames than odom and base_link."""
    if (motion.pose.parent, motion.pose.child) != (_PARENT, _CHILD):
        raise PayloadError(
            f"straitlink.bounded.Odometry is of {_CHILD} in {_PARENT}, not of {motion.pose.child!r} in "
            f"{motion.pose.parent!r}"
        )
    message = Odometry(pose=_map_pose(motion.pose))
    if motion.linear is not None and motion.angular is not None:
        for prefix, values in (("linear", motion.linear), ("angular", motion.angular)):
            for axis, value in zip("xyz", values, strict=True):
                setattr(message.twist, f"{prefix}_{axis}", value)
    return message


def motion_of(message: Odometry, capture_unix_ns: int | None) -> Motion:
    """What a bounded message says."""
    pose = message.pose
    at = FramePose(_PARENT, _CHILD, xyz(pose), _orientation(pose.orientation), capture_unix_ns or 0)
    if not message.HasField("twist"):
        return Motion(at, None, None)
    linear, angular = (_prefixed(message.twist, prefix) for prefix in ("linear", "angular"))
    return Motion(at, linear, angular)


def _prefixed(message: Any, prefix: str) -> Three:
    x, y, z = (getattr(message, f"{prefix}_{axis}") for axis in "xyz")
    return x, y, z


def transforms_of(poses: tuple[FramePose, ...]) -> FrameTransforms:
    """The bounded message. Raises PayloadError for a frame that it has no number for."""
    message = FrameTransforms()
    for pose in poses:
        message.transforms.add(parent=_frame(pose.parent), child=_frame(pose.child), pose=_map_pose(pose))
    return message


def frame_poses_of(message: FrameTransforms, capture_unix_ns: int | None) -> tuple[FramePose, ...]:
    """What a bounded message says."""
    return tuple(
        FramePose(
            FrameTransforms.Frame.Name(each.parent).lower(),
            FrameTransforms.Frame.Name(each.child).lower(),
            xyz(each.pose),
            _orientation(each.pose.orientation),
            capture_unix_ns or 0,
        )
        for each in message.transforms
    )


def _frame(name: str) -> FrameTransforms.Frame.ValueType:
    try:
        return FrameTransforms.Frame.Value(name.upper())
    except ValueError as error:
        raise PayloadError(f"straitlink.bounded.FrameTransforms has no frame {name!r}") from error


def hand_poses_of(hands: Hands) -> HandPoses:
    """The bounded message; the frame's name is left out."""
    return HandPoses(left=_hand(*hands.left), right=_hand(*hands.right))


def hands_of(message: HandPoses, capture_unix_ns: int | None) -> Hands:
    """What a bounded message says, in a frame called "tracker"."""
    left, right = ((xyz(h), _orientation(h.orientation)) for h in (message.left, message.right))
    return Hands(_TRACKER, capture_unix_ns or 0, left, right)


def _hand(position: Three, orientation: Four) -> HandPoses.Hand:
    x, y, z = position
    return HandPoses.Hand(x=x, y=y, z=z, orientation=_quaternion(orientation))


def wrench_of(value: ForceTorque) -> Wrench:
    """The bounded message."""
    (fx, fy, fz), (tx, ty, tz) = value.force, value.torque
    return Wrench(
        force=Wrench.Force(x=fx, y=fy, z=fz), torque=Wrench.Torque(x=tx, y=ty, z=tz), frame_id=value.frame
    )


def force_torque_of(message: Wrench, capture_unix_ns: int | None) -> ForceTorque:
    """What a bounded message says."""
    return ForceTorque(message.frame_id, capture_unix_ns or 0, xyz(message.force), xyz(message.torque))


ODOMETRY_MAPS = maps_of_forms(ODOMETRY_FORMS, "base_link in odom", odometry_of, motion_of)
TRANSFORM_MAPS = maps_of_forms(TRANSFORM_FORMS, "frames by number", transforms_of, frame_poses_of)
HAND_MAPS = maps_of_forms(HAND_FORMS, "hands left, right", hand_poses_of, hands_of)
WRENCH_MAPS = maps_of_forms(WRENCH_FORMS, "wrench", wrench_of, force_torque_of)

"""Poses, motions and forces as buses have them: Foxglove's, ROS 2's and our own forms of the same values.

Lengths in metres, angles in radians, quaternions (x, y, z, w); a pose is that of the child in the parent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from foxglove_schemas_protobuf.Pose_pb2 import Pose
from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame

from messages.payload.protobuf import parse, protobuf, stamp_ns, timestamp
from messages.payload.ros import cdr, read_cdr, ros_class, ros_header, stamp_ns_of, write_cdr
from messages.payload.topic_encoding import PayloadError
from messages.payload.value_map import Forms
from messages.proto.straitlink.wrench_pb2 import Wrench

Three = tuple[float, float, float]
Four = tuple[float, float, float, float]

_ODOMETRY, _TF, _POSES = "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage", "geometry_msgs/msg/PoseArray"
_WRENCH = "geometry_msgs/msg/WrenchStamped"


class HasXyz(Protocol):
    """A vector of any library."""

    x: float
    y: float
    z: float


@dataclass(frozen=True, slots=True)
class FramePose:
    """A frame's pose in another."""

    parent: str
    child: str
    position: Three
    orientation: Four
    stamp_ns: int = 0


@dataclass(frozen=True, slots=True)
class Motion:
    """A body's pose, and how it moves in its own frame (m/s, rad/s), where that is told."""

    pose: FramePose
    linear: Three | None
    angular: Three | None


@dataclass(frozen=True, slots=True)
class Hands:
    """Two poses in one frame: the left hand's, then the right one's."""

    frame: str
    stamp_ns: int
    left: tuple[Three, Four]
    right: tuple[Three, Four]


@dataclass(frozen=True, slots=True)
class ForceTorque:
    """Force (N) and torque (Nm) on the robot, in the sensor's frame."""

    frame: str
    stamp_ns: int
    force: Three
    torque: Three


def unit(quaternion: Four) -> Four:
    """The quaternion at length 1. Raises PayloadError where it has none."""
    length = math.hypot(*quaternion)
    if not 0.5 < length < 2:  # false for NaN too
        raise PayloadError(f"{quaternion} is no orientation: a quaternion of length {length:g}")
    x, y, z, w = (value / length for value in quaternion)
    return x, y, z, w


def xyz(vector: HasXyz) -> Three:
    """A vector's numbers."""
    return float(vector.x), float(vector.y), float(vector.z)


def _xyzw(quaternion: Any) -> Four:
    return unit((*xyz(quaternion), float(quaternion.w)))


def _ros_vector(values: Three, kind: str = "Vector3") -> Any:
    return ros_class(f"geometry_msgs/msg/{kind}")(*values)


def _ros_pose(position: Three, orientation: Four) -> Any:
    quaternion = ros_class("geometry_msgs/msg/Quaternion")(*orientation)
    return ros_class("geometry_msgs/msg/Pose")(_ros_vector(position, "Point"), quaternion)


def _set(message: Any, values: tuple[float, ...]) -> None:
    for name, value in zip("xyzw", values, strict=False):
        setattr(message, name, value)


# Odometry.


def read_odometry(payload: bytes) -> Motion:
    """foxglove.Odometry; covariances and metadata are left out."""
    message = parse(Odometry, payload)
    pose = FramePose(
        message.frame_id,
        message.body_frame_id,
        xyz(message.pose.position),
        _xyzw(message.pose.orientation),
        stamp_ns(message.timestamp),
    )
    moves = message.HasField("linear_velocity") and message.HasField("angular_velocity")
    if not moves:
        return Motion(pose, None, None)
    return Motion(pose, xyz(message.linear_velocity), xyz(message.angular_velocity))


def write_odometry(motion: Motion) -> bytes:
    """foxglove.Odometry."""
    pose = motion.pose
    message = Odometry(timestamp=timestamp(pose.stamp_ns), frame_id=pose.parent, body_frame_id=pose.child)
    _set(message.pose.position, pose.position)
    _set(message.pose.orientation, pose.orientation)
    if motion.linear is not None and motion.angular is not None:
        _set(message.linear_velocity, motion.linear)
        _set(message.angular_velocity, motion.angular)
    return message.SerializeToString()


def read_ros_odometry(payload: bytes) -> Motion:
    """nav_msgs/Odometry; covariances are left out."""
    message = read_cdr(payload, _ODOMETRY)
    pose, twist = message.pose.pose, message.twist.twist
    at = FramePose(
        message.header.frame_id,
        message.child_frame_id,
        xyz(pose.position),
        _xyzw(pose.orientation),
        stamp_ns_of(message.header),
    )
    return Motion(at, xyz(twist.linear), xyz(twist.angular))


def write_ros_odometry(motion: Motion) -> bytes:
    """nav_msgs/Odometry; covariances are zero, as where a publisher does not know them."""
    at, unknown = motion.pose, np.zeros(36)
    still = (0.0, 0.0, 0.0)
    twist = ros_class("geometry_msgs/msg/Twist")(
        _ros_vector(motion.linear or still), _ros_vector(motion.angular or still)
    )
    message = ros_class(_ODOMETRY)(
        ros_header(at.stamp_ns, at.parent),
        at.child,
        ros_class("geometry_msgs/msg/PoseWithCovariance")(_ros_pose(at.position, at.orientation), unknown),
        ros_class("geometry_msgs/msg/TwistWithCovariance")(twist, unknown),
    )
    return write_cdr(message, _ODOMETRY)


# Frames.


def read_transforms(payload: bytes) -> tuple[FramePose, ...]:
    """foxglove.FrameTransforms."""
    return tuple(
        FramePose(
            each.parent_frame_id,
            each.child_frame_id,
            xyz(each.translation),
            _xyzw(each.rotation),
            stamp_ns(each.timestamp),
        )
        for each in parse(FrameTransforms, payload).transforms
    )


def write_transforms(poses: tuple[FramePose, ...]) -> bytes:
    """foxglove.FrameTransforms."""
    message = FrameTransforms()
    for pose in poses:
        each: FrameTransform = message.transforms.add(
            timestamp=timestamp(pose.stamp_ns), parent_frame_id=pose.parent, child_frame_id=pose.child
        )
        _set(each.translation, pose.position)
        _set(each.rotation, pose.orientation)
    return message.SerializeToString()


def read_tf(payload: bytes) -> tuple[FramePose, ...]:
    """tf2_msgs/TFMessage."""
    return tuple(
        FramePose(
            each.header.frame_id,
            each.child_frame_id,
            xyz(each.transform.translation),
            _xyzw(each.transform.rotation),
            stamp_ns_of(each.header),
        )
        for each in read_cdr(payload, _TF).transforms
    )


def write_tf(poses: tuple[FramePose, ...]) -> bytes:
    """tf2_msgs/TFMessage."""
    transforms = [
        ros_class("geometry_msgs/msg/TransformStamped")(
            ros_header(pose.stamp_ns, pose.parent),
            pose.child,
            ros_class("geometry_msgs/msg/Transform")(
                _ros_vector(pose.position), ros_class("geometry_msgs/msg/Quaternion")(*pose.orientation)
            ),
        )
        for pose in poses
    ]
    return write_cdr(ros_class(_TF)(transforms), _TF)


# Hands.


def read_poses(payload: bytes) -> Hands:
    """foxglove.PosesInFrame of two poses."""
    message = parse(PosesInFrame, payload)
    left, right = _two([(xyz(p.position), _xyzw(p.orientation)) for p in message.poses])
    return Hands(message.frame_id, stamp_ns(message.timestamp), left, right)


def write_poses(hands: Hands) -> bytes:
    """foxglove.PosesInFrame."""
    message = PosesInFrame(timestamp=timestamp(hands.stamp_ns), frame_id=hands.frame)
    for position, orientation in (hands.left, hands.right):
        pose: Pose = message.poses.add()
        _set(pose.position, position)
        _set(pose.orientation, orientation)
    return message.SerializeToString()


def read_pose_array(payload: bytes) -> Hands:
    """geometry_msgs/PoseArray of two poses."""
    message = read_cdr(payload, _POSES)
    left, right = _two([(xyz(p.position), _xyzw(p.orientation)) for p in message.poses])
    return Hands(message.header.frame_id, stamp_ns_of(message.header), left, right)


def write_pose_array(hands: Hands) -> bytes:
    """geometry_msgs/PoseArray."""
    poses = [_ros_pose(*hand) for hand in (hands.left, hands.right)]
    return write_cdr(ros_class(_POSES)(ros_header(hands.stamp_ns, hands.frame), poses), _POSES)


def _two(poses: list[tuple[Three, Four]]) -> list[tuple[Three, Four]]:
    if len(poses) != 2:
        raise PayloadError(f"{len(poses)} poses are not two hands, left and right")
    return poses


# Forces.


def read_wrench(payload: bytes) -> ForceTorque:
    """straitlink.Wrench."""
    message = parse(Wrench, payload)
    return ForceTorque(message.frame_id, message.capture_ns, xyz(message.force), xyz(message.torque))


def write_wrench(value: ForceTorque) -> bytes:
    """straitlink.Wrench."""
    message = Wrench(capture_ns=max(0, value.stamp_ns), frame_id=value.frame)
    _set(message.force, value.force)
    _set(message.torque, value.torque)
    return message.SerializeToString()


def read_ros_wrench(payload: bytes) -> ForceTorque:
    """geometry_msgs/WrenchStamped."""
    message = read_cdr(payload, _WRENCH)
    wrench = message.wrench
    return ForceTorque(
        message.header.frame_id, stamp_ns_of(message.header), xyz(wrench.force), xyz(wrench.torque)
    )


def write_ros_wrench(value: ForceTorque) -> bytes:
    """geometry_msgs/WrenchStamped."""
    wrench = ros_class("geometry_msgs/msg/Wrench")(_ros_vector(value.force), _ros_vector(value.torque))
    return write_cdr(ros_class(_WRENCH)(ros_header(value.stamp_ns, value.frame), wrench), _WRENCH)


ODOMETRY_FORMS: Forms[Motion] = {
    protobuf(Odometry): (read_odometry, write_odometry),
    cdr(_ODOMETRY): (read_ros_odometry, write_ros_odometry),
}
TRANSFORM_FORMS: Forms[tuple[FramePose, ...]] = {
    protobuf(FrameTransforms): (read_transforms, write_transforms),
    cdr(_TF): (read_tf, write_tf),
}
HAND_FORMS: Forms[Hands] = {
    protobuf(PosesInFrame): (read_poses, write_poses),
    cdr(_POSES): (read_pose_array, write_pose_array),
}
WRENCH_FORMS: Forms[ForceTorque] = {
    protobuf(Wrench): (read_wrench, write_wrench),
    cdr(_WRENCH): (read_ros_wrench, write_ros_wrench),
}

"""Joint states as buses have them: ROS 2's sensor_msgs/JointState in CDR, and foxglove.JointStates."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from google.protobuf.message import DecodeError as ProtobufDecodeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from messages.payload.topic_encoding import PayloadError

CDR_JOINT_STATE = "application/cdr;sensor_msgs/msg/JointState"
FOXGLOVE_JOINT_STATES = "application/protobuf;foxglove.JointStates"
_ROS_TYPE = "sensor_msgs/msg/JointState"
_NS_PER_S = 1_000_000_000

QUANTITIES = ("positions", "velocities", "efforts")


@dataclass(frozen=True, slots=True)
class JointSample:
    """Some joints at one time. stamp_ns: since the Unix epoch, as the publisher stamped it.

    positions: rad or m, by joint name, in the publisher's order; velocities: per second; efforts: Nm or N.
    A joint of `names` that a quantity does not tell is not in its dict.
    """

    stamp_ns: int
    names: tuple[str, ...]
    positions: dict[str, float]
    velocities: dict[str, float]
    efforts: dict[str, float]


@cache
def ros_types() -> Typestore:
    """ROS 2's message definitions."""
    return get_typestore(Stores.LATEST)


def read_cdr(payload: bytes, ros_type: str) -> Any:
    """A ROS 2 message from its CDR. Raises PayloadError."""
    try:
        return ros_types().deserialize_cdr(payload, ros_type)
    except Exception as error:  # readers are generated and raise what struct, numpy and codecs raise
        raise PayloadError(f"a payload of {len(payload)} bytes is no CDR of {ros_type}: {error}") from error


def write_cdr(message: object, ros_type: str) -> bytes:
    """A ROS 2 message as CDR, little-endian. Raises PayloadError for a number that its field cannot hold."""
    try:
        return bytes(ros_types().serialize_cdr(message, ros_type))
    except struct.error as error:
        raise PayloadError(f"{ros_type} cannot hold what came: {error}") from error


def ros_header(stamp_ns: int, frame_id: str = "") -> Any:
    """std_msgs/Header."""
    types = ros_types().types
    time = types["builtin_interfaces/msg/Time"](*divmod(stamp_ns, _NS_PER_S))
    return types["std_msgs/msg/Header"](time, frame_id)


def stamp_ns_of(header: Any) -> int:
    """A std_msgs/Header's time, ns since the Unix epoch."""
    return int(header.stamp.sec) * _NS_PER_S + int(header.stamp.nanosec)


def read_joint_state(payload: bytes) -> JointSample:
    """sensor_msgs/JointState: arrays are empty or as long as the names."""
    message = read_cdr(payload, _ROS_TYPE)
    names = _distinct(message.name)
    told = [
        _column(names, what, values)
        for what, values in (
            ("position", message.position),
            ("velocity", message.velocity),
            ("effort", message.effort),
        )
    ]
    return JointSample(stamp_ns_of(message.header), names, *told)


def write_joint_state(sample: JointSample) -> bytes:
    """sensor_msgs/JointState. A quantity that tells no joint is empty; NaN for one that it does not tell."""
    message = ros_types().types[_ROS_TYPE](
        ros_header(sample.stamp_ns),
        list(sample.names),
        *(_array(sample.names, getattr(sample, quantity)) for quantity in QUANTITIES),
    )
    return write_cdr(message, _ROS_TYPE)


def read_joint_states(payload: bytes) -> JointSample:
    """foxglove.JointStates."""
    try:
        message = JointStates.FromString(payload)
    except ProtobufDecodeError as error:
        raise PayloadError(
            f"a payload of {len(payload)} bytes is no foxglove.JointStates: {error}"
        ) from error
    names = _distinct([joint.name for joint in message.joints])
    told = [
        {joint.name: getattr(joint, field) for joint in message.joints if joint.HasField(field)}
        for field in ("position", "velocity", "effort")
    ]
    stamp = message.timestamp
    return JointSample(stamp.seconds * _NS_PER_S + stamp.nanos, names, *told)


def write_joint_states(sample: JointSample) -> bytes:
    """foxglove.JointStates."""
    message = JointStates()
    message.timestamp.seconds, message.timestamp.nanos = divmod(sample.stamp_ns, _NS_PER_S)
    for name in sample.names:
        joint = message.joints.add(name=name)
        if name in sample.positions:
            joint.position = sample.positions[name]
        if name in sample.velocities:
            joint.velocity = sample.velocities[name]
        if name in sample.efforts:
            joint.effort = sample.efforts[name]
    return message.SerializeToString()


Reader = Callable[[bytes], JointSample]
Writer = Callable[[JointSample], bytes]

FORMS: dict[str, tuple[Reader, Writer]] = {
    CDR_JOINT_STATE: (read_joint_state, write_joint_state),
    FOXGLOVE_JOINT_STATES: (read_joint_states, write_joint_states),
}
"""Reader and writer by the bus's type."""


def _distinct(names: Iterable[str]) -> tuple[str, ...]:
    told = tuple(names)
    if len(set(told)) != len(told):
        twice = next(name for name in told if told.count(name) > 1)
        raise PayloadError(f"joint {twice!r} is named more than once")
    return told


def _column(names: tuple[str, ...], what: str, values: Sequence[float]) -> dict[str, float]:
    if len(values) not in (0, len(names)):
        raise PayloadError(f"{len(values)} values of {what} do not go with {len(names)} names")
    return {name: float(value) for name, value in zip(names, values, strict=False)}


def _array(names: tuple[str, ...], told: dict[str, float]) -> np.ndarray[Any, Any]:
    return np.array([told.get(name, np.nan) for name in names] if told else [], np.float64)

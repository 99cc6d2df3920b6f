"""Joint states as buses have them: ROS 2's sensor_msgs/JointState in CDR, and foxglove.JointStates."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates

from messages.payload.protobuf import parse, protobuf, stamp_ns, timestamp
from messages.payload.ros import cdr, read_cdr, ros_class, ros_header, stamp_ns_of, write_cdr
from messages.payload.topic_encoding import PayloadError
from messages.payload.value_map import Forms

_ROS_TYPE = "sensor_msgs/msg/JointState"
CDR_JOINT_STATE = cdr(_ROS_TYPE)
FOXGLOVE_JOINT_STATES = protobuf(JointStates)

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
    message = ros_class(_ROS_TYPE)(
        ros_header(sample.stamp_ns),
        list(sample.names),
        *(_array(sample.names, getattr(sample, quantity)) for quantity in QUANTITIES),
    )
    return write_cdr(message, _ROS_TYPE)


def read_joint_states(payload: bytes) -> JointSample:
    """foxglove.JointStates."""
    message = parse(JointStates, payload)
    names = _distinct([joint.name for joint in message.joints])
    told = [
        {joint.name: getattr(joint, field) for joint in message.joints if joint.HasField(field)}
        for field in ("position", "velocity", "effort")
    ]
    return JointSample(stamp_ns(message.timestamp), names, *told)


def write_joint_states(sample: JointSample) -> bytes:
    """foxglove.JointStates."""
    message = JointStates(timestamp=timestamp(sample.stamp_ns))
    for name in sample.names:
        joint = message.joints.add(name=name)
        if name in sample.positions:
            joint.position = sample.positions[name]
        if name in sample.velocities:
            joint.velocity = sample.velocities[name]
        if name in sample.efforts:
            joint.effort = sample.efforts[name]
    return message.SerializeToString()


FORMS: Forms[JointSample] = {
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

"""Joint states of a bus as a robot's own bounded message (`messages.from_urdf`), and back."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message

from messages.dccl.options import as_descriptor, field_options
from messages.payload.joints import FORMS, QUANTITIES, JointSample
from messages.payload.topic_encoding import PayloadError
from messages.payload.value_map import ValueMap, maps_of_forms

_NS_PER_MS = 1_000_000
_TURN_RAD = 2 * math.pi


class JointSchema:
    """Which field tells which joint, read from a message type.

    A NaN counts as not told. A continuous joint's angle is taken modulo a turn.
    """

    def __init__(self, message_type: type[Message]) -> None:
        self.message_type = message_type
        self.name = as_descriptor(message_type).full_name
        fields = as_descriptor(message_type).fields_by_name
        self.has_stamp = "stamp_ms" in fields
        groups = {q: _fields_of(fields[q]) for q in QUANTITIES if q in fields}
        self.groups = {q: {_joint_of(f): f.name for f in group} for q, group in groups.items()}
        self.wraps = frozenset(_joint_of(f) for f in groups["positions"] if _is_continuous(f))
        self.names = tuple(self.groups["positions"])

    @property
    def description(self) -> str:
        """What both sides must agree on."""
        joints = [name + "~" * (name in self.wraps) for name in self.names]
        return f"joints {', '.join(self.groups)} of {joints}"

    def message_of(self, sample: JointSample) -> Message:
        """The bounded message. Raises PayloadError for a joint, or a quantity, that it has no field for."""
        message = self.message_type()
        if self.has_stamp:
            if sample.stamp_ns < 0:
                raise PayloadError(f"{self.name}: a stamp of {sample.stamp_ns} ns is before 1970")
            message.stamp_ms = (sample.stamp_ns + _NS_PER_MS // 2) // _NS_PER_MS  # type: ignore[attr-defined]
        for quantity, fields in self.groups.items():
            told: dict[str, float] = getattr(sample, quantity)
            if not told:
                continue
            group = getattr(message, quantity)
            group.SetInParent()
            for joint, value in told.items():
                if joint not in fields:
                    raise PayloadError(f"{self.name}.{quantity} has no joint {joint!r}")
                if math.isnan(value):
                    continue
                setattr(group, fields[joint], self._wrapped(joint, value, quantity))
        return message

    def sample_of(self, message: Any, capture_unix_ns: int | None) -> JointSample:
        """What a bounded message says, in the order of its fields."""
        told: dict[str, dict[str, float]] = {quantity: {} for quantity in QUANTITIES}
        for quantity, fields in self.groups.items():
            group = getattr(message, quantity)
            told[quantity] = {
                j: getattr(group, field) for j, field in fields.items() if group.HasField(field)
            }
        names = tuple(name for name in self.names if any(name in told[quantity] for quantity in QUANTITIES))
        if self.has_stamp and message.HasField("stamp_ms"):
            return JointSample(message.stamp_ms * _NS_PER_MS, names, **told)
        return JointSample(capture_unix_ns or 0, names, **told)

    def _wrapped(self, joint: str, value: float, quantity: str) -> float:
        if quantity != "positions" or joint not in self.wraps or not math.isfinite(value):
            return value
        return math.remainder(value, _TURN_RAD)


def joint_maps(message_type: type[Message]) -> tuple[ValueMap[JointSample], ...]:
    """Maps to and from joint states, if the message has groups of joints; else none."""
    positions = as_descriptor(message_type).fields_by_name.get("positions")
    if positions is None or positions.message_type is None or positions.is_repeated:
        return ()
    if any(field.type != FieldDescriptor.TYPE_DOUBLE for field in positions.message_type.fields):
        return ()
    schema = JointSchema(message_type)
    return maps_of_forms(FORMS, schema.description, schema.message_of, schema.sample_of)


def joint_names(group: type[Message]) -> dict[str, str]:
    """The fields of a group of joints, by the joint's name."""
    return {_joint_of(field): field.name for field in as_descriptor(group).fields}


def _fields_of(group: FieldDescriptor) -> Sequence[FieldDescriptor]:
    return () if group.message_type is None else group.message_type.fields


def _joint_of(field: FieldDescriptor) -> str:
    return str(field.json_name)


def _is_continuous(field: FieldDescriptor) -> bool:
    return field_options(field).description == "continuous"

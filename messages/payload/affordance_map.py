"""Affordances as Foxglove's scene entities, which a 3D panel shows: an arrow along the template's x axis.

The entity's id is "affordance/ID"; its metadata hold template_id and parameter_0, parameter_1 and so on.
"""

from __future__ import annotations

from foxglove_schemas_protobuf.ArrowPrimitive_pb2 import ArrowPrimitive
from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.message import Message

from messages.payload.poses import unit, xyz
from messages.payload.protobuf import parse, protobuf, timestamp
from messages.payload.topic_encoding import PayloadError
from messages.proto.straitlink.bounded.affordance_pb2 import Affordance

_FRAME = "base_link"
_ID = "affordance/"
_TEMPLATE, _PARAMETER = "template_id", "parameter_"
_SHAFT_M, _HEAD_M, _WIDTH_M = 0.15, 0.05, 0.02
_COLOUR = {"r": 1.0, "g": 0.6, "b": 0.0, "a": 1.0}


class SceneUpdateMap:
    """foxglove.SceneUpdate of one entity; what else the entity shows does not cross."""

    bus_type = protobuf(SceneUpdate)
    description = "affordance as arrow"

    def to_message(self, payload: bytes) -> Message:
        """The affordance. Raises PayloadError where the scene is something else."""
        update = parse(SceneUpdate, payload)
        if len(update.entities) != 1 or update.deletions:
            counts = f"{len(update.entities)} entities and {len(update.deletions)} deletions"
            raise PayloadError(f"a scene update of {counts} is not one affordance")
        (entity,) = update.entities
        if entity.frame_id != _FRAME:
            raise PayloadError(f"affordance {entity.id!r}: frame_id = {entity.frame_id!r} is not {_FRAME!r}")
        if len(entity.arrows) != 1:
            raise PayloadError(
                f"affordance {entity.id!r} has {len(entity.arrows)} arrows; its pose is that of one"
            )
        told = {pair.key: pair.value for pair in entity.metadata}
        message = Affordance(
            affordance_id=_integer("id", entity.id.removeprefix(_ID)),
            template_id=_integer(_TEMPLATE, told.pop(_TEMPLATE, "")),
        )
        pose = entity.arrows[0].pose
        message.pose.x, message.pose.y, message.pose.z = xyz(pose.position)
        q = pose.orientation
        turn = message.pose.orientation
        turn.x, turn.y, turn.z, turn.w = unit((q.x, q.y, q.z, q.w))
        for number in range(len(told)):
            message.parameters.append(_real(f"{_PARAMETER}{number}", told))
        return message

    def to_payload(self, message: Message, capture_unix_ns: int | None) -> bytes:
        """The entity, which replaces the one that had its id."""
        assert isinstance(message, Affordance)
        entity = SceneEntity(
            timestamp=timestamp(capture_unix_ns or 0), frame_id=_FRAME, id=f"{_ID}{message.affordance_id}"
        )
        entity.metadata.add(key=_TEMPLATE, value=str(message.template_id))
        for number, value in enumerate(message.parameters):
            entity.metadata.add(key=f"{_PARAMETER}{number}", value=f"{value:.10g}")
        arrow: ArrowPrimitive = entity.arrows.add(
            shaft_length=_SHAFT_M, shaft_diameter=_WIDTH_M, head_length=_HEAD_M, head_diameter=2 * _WIDTH_M
        )
        position, turn, q = arrow.pose.position, arrow.pose.orientation, message.pose.orientation
        position.x, position.y, position.z = xyz(message.pose)
        turn.x, turn.y, turn.z, turn.w = unit((q.x, q.y, q.z, q.w))
        for channel, share in _COLOUR.items():
            setattr(arrow.color, channel, share)
        return SceneUpdate(entities=[entity]).SerializeToString()


def _integer(what: str, text: str) -> int:
    if not (text.isascii() and text.isdecimal() and len(text) <= 3):
        raise PayloadError(f"an affordance's {what} = {text[:40]!r} is not a number within 0..255")
    return int(text)


def _real(key: str, told: dict[str, str]) -> float:
    try:
        return float(told[key])
    except KeyError:
        raise PayloadError(f"an affordance's metadata {sorted(told)} lack {key}") from None
    except ValueError:
        raise PayloadError(f"an affordance's {key} = {told[key][:40]!r} is not a number") from None

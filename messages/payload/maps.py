"""Which payload types of a bus each bounded message can say."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from google.protobuf.message import Message

from messages.payload.affordance_map import SceneUpdateMap
from messages.payload.bounded import PayloadMap
from messages.payload.joint_maps import joint_maps
from messages.payload.pivot_map import PivotPlanMap
from messages.payload.plan_maps import FOOTSTEP_PLAN_MAPS, MOTION_PLAN_MAPS
from messages.payload.pose_maps import HAND_MAPS, ODOMETRY_MAPS, TRANSFORM_MAPS, WRENCH_MAPS
from messages.payload.processes import ProcessStatusMap

_MAPS: Mapping[str, Sequence[PayloadMap]] = {
    "straitlink.bounded.Odometry": ODOMETRY_MAPS,
    "straitlink.bounded.FrameTransforms": TRANSFORM_MAPS,
    "straitlink.bounded.HandPoses": HAND_MAPS,
    "straitlink.bounded.Wrench": WRENCH_MAPS,
    "straitlink.bounded.MotionPlan": MOTION_PLAN_MAPS,
    "straitlink.bounded.FootstepPlan": FOOTSTEP_PLAN_MAPS,
    "straitlink.bounded.Affordance": (SceneUpdateMap(),),
    "straitlink.bounded.PivotPlan": (PivotPlanMap(),),
    "straitlink.bounded.ProcessReport": (ProcessStatusMap(),),
}


def maps_of(message_type: type[Message]) -> Sequence[PayloadMap]:
    """Maps of a message of the catalogue, or of one with groups of joints; beside these, any message is
    said by itself."""
    return _MAPS.get(message_type.DESCRIPTOR.full_name) or joint_maps(message_type)

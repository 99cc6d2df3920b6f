"""The bounded messages that come with straitlink: what crosses a thin link in place of what buses carry."""

from __future__ import annotations

from dataclasses import dataclass

from google.protobuf.message import Message

from messages.catalogue import TrafficClassName
from messages.proto.straitlink.bounded.affordance_pb2 import Affordance
from messages.proto.straitlink.bounded.footstep_plan_pb2 import FootstepPlan
from messages.proto.straitlink.bounded.frame_transforms_pb2 import FrameTransforms
from messages.proto.straitlink.bounded.hand_poses_pb2 import HandPoses
from messages.proto.straitlink.bounded.joint_command_pb2 import JointCommand
from messages.proto.straitlink.bounded.link_status_pb2 import LinkStatus
from messages.proto.straitlink.bounded.motion_plan_pb2 import MotionPlan
from messages.proto.straitlink.bounded.odometry_pb2 import Odometry
from messages.proto.straitlink.bounded.pivot_plan_pb2 import PivotPlan
from messages.proto.straitlink.bounded.process_report_pb2 import ProcessReport
from messages.proto.straitlink.bounded.receipt_pb2 import Receipt
from messages.proto.straitlink.bounded.robot_state_pb2 import RobotState
from messages.proto.straitlink.bounded.steering_command_pb2 import SteeringCommand
from messages.proto.straitlink.bounded.wrench_pb2 import Wrench
from messages.proto.straitlink.emergency_stop_pb2 import EmergencyStop
from messages.proto.straitlink.heartbeat_pb2 import Heartbeat


@dataclass(frozen=True, slots=True)
class BoundedMessage:
    """One message. purpose: in a line; traffic_class: the one it belongs to, unless someone knows better."""

    message_type: type[Message]
    purpose: str
    traffic_class: TrafficClassName

    @property
    def name(self) -> str:
        """Its full protobuf name, by which a configuration's [encodings] take it."""
        return str(self.message_type.DESCRIPTOR.full_name)


BOUNDED_CATALOGUE: tuple[BoundedMessage, ...] = (
    BoundedMessage(Heartbeat, '"I am alive", with what the sender is doing', "heartbeat"),
    BoundedMessage(EmergencyStop, "stop now, or the release of such a stop", "emergency"),
    BoundedMessage(RobotState, "Atlas v4: 28 joints, pelvis, feet and hands", "state"),
    BoundedMessage(JointCommand, "HUBO2+: where its joints shall go", "command"),
    BoundedMessage(Odometry, "where the base is and how it moves", "state"),
    BoundedMessage(FrameTransforms, "frames in frames, by number instead of by name", "state"),
    BoundedMessage(Wrench, "force and torque at a limb's sensor", "state"),
    BoundedMessage(HandPoses, "an operator's two hands from a 6-DoF tracker", "command"),
    BoundedMessage(MotionPlan, "Atlas v4: joint trajectories of the upper body", "plan"),
    BoundedMessage(FootstepPlan, "where the feet shall go, in order", "plan"),
    BoundedMessage(Affordance, "an object that a template was fitted to", "command"),
    BoundedMessage(SteeringCommand, "turn a vehicle's wheel by an angle", "command"),
    BoundedMessage(PivotPlan, "walk a bulky object on its lower corners", "plan"),
    BoundedMessage(ProcessReport, "processes by a hash of their name; each name crosses once", "state"),
    BoundedMessage(LinkStatus, "what a shaper believes of its link", "state"),
    BoundedMessage(Receipt, "how far a reliable message has come", "state"),
)

_BY_NAME = {message.name: message for message in BOUNDED_CATALOGUE}


def find_bounded(name: str) -> BoundedMessage | None:
    """A message by its full protobuf name; None for one that is not here."""
    return _BY_NAME.get(name)

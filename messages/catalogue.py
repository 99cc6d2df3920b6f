"""The one table of the mission's topics: key, type, direction, rate and default traffic class.

Keys have no leading slash (Zenoh); the topic of the same name in an MCAP file is "/" + key.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry
from google.protobuf.message import Message

from messages.proto.straitlink.emergency_stop_pb2 import EmergencyStop
from messages.proto.straitlink.footstep_plan_pb2 import FootstepPlan
from messages.proto.straitlink.heartbeat_pb2 import Heartbeat
from messages.proto.straitlink.imu_pb2 import Imu
from messages.proto.straitlink.motion_plan_pb2 import MotionPlan
from messages.proto.straitlink.process_status_pb2 import ProcessStatus
from messages.proto.straitlink.view_pb2 import ViewRequest
from messages.proto.straitlink.wrench_pb2 import Wrench

Direction = Literal["down", "up"]
TrafficClassName = Literal["emergency", "heartbeat", "command", "plan", "state", "perception", "bulk"]


@dataclass(frozen=True, slots=True)
class CatalogueTopic:
    """One topic of the mission.

    key: Zenoh key, no leading slash.
    message_type: the protobuf class of its payload.
    direction: "down" from robot to operator, "up" from operator to robot.
    rate_hz: how often it is published; the mean for topics that come on events.
    traffic_class: the class it belongs to unless a configuration says otherwise.
    """

    key: str
    message_type: type[Message]
    direction: Direction
    rate_hz: float
    traffic_class: TrafficClassName

    @property
    def mcap_topic(self) -> str:
        """The topic's name in an MCAP file: the key with a leading slash."""
        return "/" + self.key

    @property
    def schema_name(self) -> str:
        """The full protobuf name, "foxglove.LaserScan": also the MCAP schema's name."""
        return str(self.message_type.DESCRIPTOR.full_name)


# The controllers run on a 3 ms tick, so what the paper calls 333 Hz is exactly 1000/3 Hz.
CONTROL_RATE_HZ = 1000 / 3

CATALOGUE: tuple[CatalogueTopic, ...] = (
    CatalogueTopic("robot/heartbeat", Heartbeat, "down", 10, "heartbeat"),
    CatalogueTopic("robot/joint_states", JointStates, "down", CONTROL_RATE_HZ, "state"),
    CatalogueTopic("robot/joint_commands", JointStates, "down", CONTROL_RATE_HZ, "bulk"),
    CatalogueTopic("robot/odometry", Odometry, "down", CONTROL_RATE_HZ, "state"),
    CatalogueTopic("robot/tf", FrameTransforms, "down", CONTROL_RATE_HZ, "state"),
    CatalogueTopic("robot/tf_static", FrameTransforms, "down", 1, "state"),
    CatalogueTopic("robot/imu", Imu, "down", 1000, "bulk"),
    CatalogueTopic("robot/force_torque/l_foot", Wrench, "down", CONTROL_RATE_HZ, "state"),
    CatalogueTopic("robot/force_torque/r_foot", Wrench, "down", CONTROL_RATE_HZ, "state"),
    CatalogueTopic("robot/force_torque/l_hand", Wrench, "down", CONTROL_RATE_HZ, "state"),
    CatalogueTopic("robot/force_torque/r_hand", Wrench, "down", CONTROL_RATE_HZ, "state"),
    CatalogueTopic("robot/lidar/spindle", JointStates, "down", CONTROL_RATE_HZ, "bulk"),
    CatalogueTopic("robot/lidar/scan", LaserScan, "down", 40, "perception"),
    CatalogueTopic("robot/head_camera/image", CompressedImage, "down", 20, "perception"),
    CatalogueTopic("robot/head_camera/calibration", CameraCalibration, "down", 1, "bulk"),
    CatalogueTopic("robot/chest_camera/image", CompressedImage, "down", 5, "perception"),
    CatalogueTopic("robot/chest_camera/calibration", CameraCalibration, "down", 1, "bulk"),
    CatalogueTopic("robot/process_status", ProcessStatus, "down", 1, "state"),
    CatalogueTopic("operator/heartbeat", Heartbeat, "up", 10, "heartbeat"),
    CatalogueTopic("operator/emergency_stop", EmergencyStop, "up", 0, "command"),
    CatalogueTopic("operator/footstep_plan", FootstepPlan, "up", 1 / 12, "command"),
    CatalogueTopic("operator/motion_plan", MotionPlan, "up", 1 / 9, "command"),
    CatalogueTopic("operator/view_request", ViewRequest, "up", 1 / 4, "command"),
)

_BY_KEY = {topic.key: topic for topic in CATALOGUE}


def find_topic(key: str) -> CatalogueTopic | None:
    """The catalogue's row for a key (without leading slash); None for a topic that it does not hold."""
    return _BY_KEY.get(key)

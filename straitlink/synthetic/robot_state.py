"""What the robot's body tells: joints, odometry, transforms, inertial unit, force and torque."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from functools import partial

import numpy as np
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.JointState_pb2 import JointState
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from foxglove_schemas_protobuf.Odometry_pb2 import Odometry

from messages.catalogue import CatalogueTopic
from messages.proto.straitlink.imu_pb2 import Imu
from messages.proto.straitlink.wrench_pb2 import Wrench
from straitlink.synthetic.frames import (
    DYNAMIC_FRAMES,
    SPINDLE_RADPS,
    STATIC_FRAMES,
    dynamic_transforms,
    spindle_angles,
)
from straitlink.synthetic.gait import stance_load_ratio, walking_pose
from straitlink.synthetic.joints import (
    EFFORT_NM,
    JOINT_NAMES,
    LOWER_RAD,
    UPPER_RAD,
    VELOCITY_RADPS,
    joint_efforts,
    joint_positions,
    joint_velocities,
)
from straitlink.synthetic.rigid import FloatArray, quaternion_from_rotation
from straitlink.synthetic.settings import SyntheticSettings
from straitlink.synthetic.ticks import Block, blocks, stamp

Samples = Iterator[tuple[int, bytes]]  # capture_ns and payload, in order of time

_STREAM = 110  # plus one per noisy topic
_POSITION_SIGMA_RAD = 2e-4
_VELOCITY_SIGMA_RADPS = 5e-3
_EFFORT_SIGMA_RATIO = 2e-3
_GYROSCOPE_SIGMA_RADPS = 2e-3
_ACCELEROMETER_SIGMA_MPS2 = 0.03
_GRAVITY_MPS2 = 9.80665
_WEIGHT_N = 155.0 * _GRAVITY_MPS2  # Atlas of 2013 with its hands
_HAND_WEIGHT_N = 25.0
_IMU_STEP_S = 1e-3


def joint_states(topic: CatalogueTopic, settings: SyntheticSettings) -> Samples:
    """Measured positions, velocities and efforts of the 28 joints, within the robot's limits."""
    random = np.random.default_rng([settings.seed, _STREAM])
    message = JointStates(joints=[JointState(name=name) for name in JOINT_NAMES])
    for block in blocks(topic, settings):
        noise = random.standard_normal((3, block.times_s.size, len(JOINT_NAMES)))
        truth = joint_positions(block.times_s, settings.seed)
        positions = np.clip(truth + _POSITION_SIGMA_RAD * noise[0], LOWER_RAD, UPPER_RAD)
        velocities = joint_velocities(block.times_s, settings.seed) + _VELOCITY_SIGMA_RADPS * noise[1]
        velocities = np.clip(velocities, -VELOCITY_RADPS, VELOCITY_RADPS)
        efforts = joint_efforts(block.times_s, truth) + _EFFORT_SIGMA_RATIO * EFFORT_NM * noise[2]
        yield from _joint_messages(message, block, positions, velocities, efforts)


def joint_commands(topic: CatalogueTopic, settings: SyntheticSettings) -> Samples:
    """What the controller asks of the joints: the same motion without noise, 10 ms ahead."""
    message = JointStates(joints=[JointState(name=name) for name in JOINT_NAMES])
    for block in blocks(topic, settings):
        ahead = block.times_s + 0.01
        positions = joint_positions(ahead, settings.seed)
        velocities = joint_velocities(ahead, settings.seed)
        yield from _joint_messages(message, block, positions, velocities, joint_efforts(ahead, positions))


def spindle_state(topic: CatalogueTopic, settings: SyntheticSettings) -> Samples:
    """The spindle's angle, wrapped to one turn, and its rate."""
    message = JointStates(joints=[JointState(name="spindle")])
    for block in blocks(topic, settings):
        angles = np.mod(spindle_angles(block.times_s), 2 * np.pi)
        for capture_ns, angle in zip(block.capture_ns.tolist(), angles.tolist(), strict=True):
            stamp(message.timestamp, capture_ns)
            message.joints[0].position, message.joints[0].velocity = angle, SPINDLE_RADPS
            yield capture_ns, message.SerializeToString()


def odometry(topic: CatalogueTopic, settings: SyntheticSettings) -> Samples:
    """The pelvis in `odom`, its velocities in its own frame."""
    message = Odometry(frame_id="odom", body_frame_id="base_link")
    position, orientation = message.pose.position, message.pose.orientation
    linear, angular = message.linear_velocity, message.angular_velocity
    for block in blocks(topic, settings):
        odom_from_base = dynamic_transforms(block.times_s, settings.seed)[:, 1]
        velocity, rate, _ = _body_motion(block.times_s)
        quaternion = quaternion_from_rotation(odom_from_base[:, :3, :3])
        rows = np.concatenate([odom_from_base[:, :3, 3], quaternion, velocity, rate], axis=1)
        for capture_ns, row in zip(block.capture_ns.tolist(), rows.tolist(), strict=True):
            stamp(message.timestamp, capture_ns)
            position.x, position.y, position.z = row[:3]
            orientation.x, orientation.y, orientation.z, orientation.w = row[3:7]
            linear.x, linear.y, linear.z, angular.x, angular.y, angular.z = row[7:]
            yield capture_ns, message.SerializeToString()


def moving_frames(topic: CatalogueTopic, settings: SyntheticSettings) -> Samples:
    """The transforms that change, all nine in one message."""
    message = _frames(DYNAMIC_FRAMES)
    for block in blocks(topic, settings):
        yield from _frame_messages(message, block, dynamic_transforms(block.times_s, settings.seed))


def fixed_frames(topic: CatalogueTopic, settings: SyntheticSettings) -> Samples:
    """Where the sensors are mounted, once a second for those who join late."""
    message = _frames([(parent, child) for parent, child, _ in STATIC_FRAMES])
    mounts = np.array([matrix for _, _, matrix in STATIC_FRAMES])
    for block in blocks(topic, settings):
        matrices = np.broadcast_to(mounts, (block.times_s.size, *mounts.shape))
        yield from _frame_messages(message, block, matrices)


def imu(topic: CatalogueTopic, settings: SyntheticSettings) -> Samples:
    """The pelvis's inertial unit: orientation in `map`, rates and specific force in base_link."""
    random = np.random.default_rng([settings.seed, _STREAM + 1])
    message = Imu(frame_id="base_link")
    orientation, angular, linear = message.orientation, message.angular_velocity, message.linear_acceleration
    for block in blocks(topic, settings):
        noise = random.standard_normal((2, block.times_s.size, 3))
        _, rate, force = _body_motion(block.times_s)
        quaternion = quaternion_from_rotation(walking_pose(block.times_s)[:, :3, :3])
        rate = rate + _GYROSCOPE_SIGMA_RADPS * noise[0]
        force = force + _ACCELEROMETER_SIGMA_MPS2 * noise[1]
        rows = np.concatenate([quaternion, rate, force], axis=1)
        for capture_ns, row in zip(block.capture_ns.tolist(), rows.tolist(), strict=True):
            message.capture_ns = capture_ns
            orientation.x, orientation.y, orientation.z, orientation.w = row[:4]
            angular.x, angular.y, angular.z, linear.x, linear.y, linear.z = row[4:]
            yield capture_ns, message.SerializeToString()


def force_torque(limb: str, topic: CatalogueTopic, settings: SyntheticSettings) -> Samples:
    """A limb's six-axis sensor: feet carry the robot in turn, hands their own weight.

    limb: "l_foot", "r_foot", "l_hand" or "r_hand"; also the frame.
    """
    left, foot = limb.startswith("l"), limb.endswith("foot")
    random = np.random.default_rng([settings.seed, _STREAM + 2, left, foot])
    sigma = np.array([4.0, 4.0, 8.0, 0.5, 0.5, 0.2]) if foot else np.array([0.3, 0.3, 0.3, 0.02, 0.02, 0.02])
    message = Wrench(frame_id=limb)
    force, torque = message.force, message.torque
    for block in blocks(topic, settings):
        rows = sigma * random.standard_normal((block.times_s.size, 6))
        if foot:
            load = _WEIGHT_N * stance_load_ratio(block.times_s, left=left)
            rows[:, 2] += load
            rows[:, 4] += 0.02 * load  # the centre of pressure lies 2 cm behind the sensor
        else:
            rows[:, 2] -= _HAND_WEIGHT_N
        for capture_ns, row in zip(block.capture_ns.tolist(), rows.tolist(), strict=True):
            message.capture_ns = capture_ns
            force.x, force.y, force.z, torque.x, torque.y, torque.z = row
            yield capture_ns, message.SerializeToString()


STATE_SOURCES: dict[str, Callable[[CatalogueTopic, SyntheticSettings], Samples]] = {
    "robot/joint_states": joint_states,
    "robot/joint_commands": joint_commands,
    "robot/lidar/spindle": spindle_state,
    "robot/odometry": odometry,
    "robot/tf": moving_frames,
    "robot/tf_static": fixed_frames,
    "robot/imu": imu,
    **{
        f"robot/force_torque/{limb}": partial(force_torque, limb)
        for limb in ("l_foot", "r_foot", "l_hand", "r_hand")
    },
}


def _joint_messages(
    message: JointStates, block: Block, positions: FloatArray, velocities: FloatArray, efforts: FloatArray
) -> Samples:
    joints = list(message.joints)
    columns = (positions.tolist(), velocities.tolist(), efforts.tolist())
    for capture_ns, *row in zip(block.capture_ns.tolist(), *columns, strict=True):
        stamp(message.timestamp, capture_ns)
        for joint, position, velocity, effort in zip(joints, *row, strict=True):
            joint.position, joint.velocity, joint.effort = position, velocity, effort
        yield capture_ns, message.SerializeToString()


def _frames(pairs: Iterable[tuple[str, str]]) -> FrameTransforms:
    return FrameTransforms(
        transforms=[FrameTransform(parent_frame_id=parent, child_frame_id=child) for parent, child in pairs]
    )


def _frame_messages(message: FrameTransforms, block: Block, matrices: FloatArray) -> Samples:
    """matrices: (T, frames, 4, 4) parent_from_child."""
    parts = [(item.timestamp, item.translation, item.rotation) for item in message.transforms]
    quaternions = quaternion_from_rotation(matrices[..., :3, :3])
    rows = np.concatenate([matrices[..., :3, 3], quaternions], axis=-1)
    for capture_ns, values in zip(block.capture_ns.tolist(), rows.tolist(), strict=True):
        for (time, translation, rotation), row in zip(parts, values, strict=True):
            stamp(time, capture_ns)
            translation.x, translation.y, translation.z, rotation.x, rotation.y, rotation.z, rotation.w = row
        yield capture_ns, message.SerializeToString()


def _body_motion(times_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Velocity (m/s), turn rate (rad/s) and specific force (m/s^2), each (T, 3) in base_link.

    By central differences over +-1 ms of the exact pose.
    """
    step = _IMU_STEP_S
    before, here, after = (walking_pose(times_s + shift) for shift in (-step, 0.0, step))
    base_from_map = np.swapaxes(here[:, :3, :3], 1, 2)
    velocity = (after[:, :3, 3] - before[:, :3, 3]) / (2 * step)
    acceleration = (after[:, :3, 3] - 2 * here[:, :3, 3] + before[:, :3, 3]) / step**2
    spin = base_from_map @ (after[:, :3, :3] - before[:, :3, :3]) / (2 * step)
    rate = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
    force = acceleration + np.array([0.0, 0.0, _GRAVITY_MPS2])
    return (
        np.einsum("tij,tj->ti", base_from_map, velocity),
        rate,
        np.einsum("tij,tj->ti", base_from_map, force),
    )

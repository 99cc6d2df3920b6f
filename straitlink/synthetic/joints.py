"""The robot's 28 actuated joints: names, limits, and where they are while it walks."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from straitlink.synthetic.gait import foot_poses, stance_load_ratio, walking_pose
from straitlink.synthetic.rigid import FloatArray, inverse


@dataclass(frozen=True, slots=True)
class JointLimit:
    """One row of the robot's table: radians, rad/s, Nm."""

    name: str
    lower_rad: float
    upper_rad: float
    velocity_radps: float
    effort_nm: float


# Atlas v4: the 30 joints of openhumanoids/oh-distro's atlas_v4.urdf (BSD-3) without the two locked
# *_arm_wry2, in the order back, neck, left arm, right arm, left leg, right leg.
JOINT_LIMITS: tuple[JointLimit, ...] = (
    JointLimit("back_bkz", -0.663225, 0.663225, 12, 106),
    JointLimit("back_bky", -0.219388, 0.538783, 9, 445),
    JointLimit("back_bkx", -0.523599, 0.523599, 12, 300),
    JointLimit("neck_ry", -0.602139, 1.14319, 6.28, 5),
    JointLimit("l_arm_shz", -1.5708, 0.785398, 12, 87),
    JointLimit("l_arm_shx", -1.5708, 1.5708, 12, 99),
    JointLimit("l_arm_ely", 0, 3.14159, 12, 63),
    JointLimit("l_arm_elx", 0, 2.35619, 12, 112),
    JointLimit("l_arm_wry", 0, 3.14159, 12, 25),
    JointLimit("l_arm_wrx", -1.1781, 1.1781, 12, 25),
    JointLimit("r_arm_shz", -0.785398, 1.5708, 12, 87),
    JointLimit("r_arm_shx", -1.5708, 1.5708, 12, 99),
    JointLimit("r_arm_ely", 0, 3.14159, 12, 63),
    JointLimit("r_arm_elx", -2.35619, 0, 12, 112),
    JointLimit("r_arm_wry", 0, 3.14159, 12, 25),
    JointLimit("r_arm_wrx", -1.1781, 1.1781, 12, 25),
    JointLimit("l_leg_hpz", -0.174358, 0.786794, 12, 275),
    JointLimit("l_leg_hpx", -0.523599, 0.523599, 12, 530),
    JointLimit("l_leg_hpy", -1.61234, 0.65764, 12, 840),
    JointLimit("l_leg_kny", 0, 2.35637, 12, 890),
    JointLimit("l_leg_aky", -1, 0.7, 12, 740),
    JointLimit("l_leg_akx", -0.8, 0.8, 12, 360),
    JointLimit("r_leg_hpz", -0.786794, 0.174358, 12, 275),
    JointLimit("r_leg_hpx", -0.523599, 0.523599, 12, 530),
    JointLimit("r_leg_hpy", -1.61234, 0.65764, 12, 840),
    JointLimit("r_leg_kny", 0, 2.35637, 12, 890),
    JointLimit("r_leg_aky", -1, 0.7, 12, 740),
    JointLimit("r_leg_akx", -0.8, 0.8, 12, 360),
)
JOINT_NAMES: tuple[str, ...] = tuple(limit.name for limit in JOINT_LIMITS)
LOWER_RAD = np.array([limit.lower_rad for limit in JOINT_LIMITS])
UPPER_RAD = np.array([limit.upper_rad for limit in JOINT_LIMITS])
VELOCITY_RADPS = np.array([limit.velocity_radps for limit in JOINT_LIMITS])
EFFORT_NM = np.array([limit.effort_nm for limit in JOINT_LIMITS])

_STREAM = 102
_HIP_OFFSET_M = 0.089  # half the distance between the hips
_THIGH_M = 0.374
_SHANK_M = 0.422
_VELOCITY_STEP_S = 0.5e-3

# Where arms, back and neck rest, and how far they swing about it; radians.
_REST_RAD = np.array([0.0, 0.06, 0.0, 0.24, -0.3, -1.15, 1.9, 1.3, 1.2, 0.0, 0.3, 1.15, 1.9, -1.3, 1.2, 0.0])
_SWING_RAD = np.array(
    [0.12, 0.03, 0.02, 0.16, 0.2, 0.12, 0.25, 0.3, 0.3, 0.2, 0.2, 0.12, 0.25, 0.3, 0.3, 0.2]
)


@cache
def _upper_body_waves(seed: int) -> tuple[FloatArray, FloatArray]:
    random = np.random.default_rng([seed, _STREAM])
    period_s = random.uniform(4.0, 13.0, _REST_RAD.size)
    return 2 * np.pi / period_s, random.uniform(0.0, 2 * np.pi, _REST_RAD.size)


def joint_positions(times_s: FloatArray, seed: int) -> FloatArray:
    """(T, 28) radians in the order of JOINT_LIMITS, without noise; the legs keep the soles on the ground."""
    upper = upper_body_positions(times_s, seed)
    return np.concatenate([upper, _leg(times_s, left=True), _leg(times_s, left=False)], axis=1)


def upper_body_positions(times_s: FloatArray, seed: int) -> FloatArray:
    """(T, 16) radians: the first of `joint_positions`, back, neck and arms, which need no kinematics."""
    angular_rate, phase = _upper_body_waves(seed)
    positions: FloatArray = _REST_RAD + _SWING_RAD * np.sin(times_s[:, None] * angular_rate + phase)
    return positions


def joint_velocities(times_s: FloatArray, seed: int) -> FloatArray:
    """(T, 28) rad/s: central difference over 1 ms."""
    step = _VELOCITY_STEP_S
    after, before = joint_positions(times_s + step, seed), joint_positions(times_s - step, seed)
    velocities: FloatArray = (after - before) / (2 * step)
    return velocities


def joint_efforts(times_s: FloatArray, positions_rad: FloatArray) -> FloatArray:
    """(T, 28) Nm: what holds each joint, proportional to its bend; legs by the weight that they carry.

    A figure of the right size and rhythm, not dynamics.
    """
    share = np.full((times_s.size, len(JOINT_LIMITS)), 0.15)
    share[:, 16:22] = 0.35 * stance_load_ratio(times_s, left=True)[:, None]
    share[:, 22:28] = 0.35 * stance_load_ratio(times_s, left=False)[:, None]
    efforts: FloatArray = EFFORT_NM * share * np.sin(positions_rad)
    return efforts


def _leg(times_s: FloatArray, *, left: bool) -> FloatArray:
    """(T, 6) hpz, hpx, hpy, kny, aky, akx of one leg: planar two-link inverse kinematics."""
    map_from_base = walking_pose(times_s)
    base_from_foot = inverse(map_from_base) @ foot_poses(times_s, left=left)
    reach = base_from_foot[:, :3, 3] - [0.0, _HIP_OFFSET_M if left else -_HIP_OFFSET_M, 0.0]
    length = np.linalg.norm(reach, axis=1)
    knee = np.pi - _angle_opposite(length, _THIGH_M, _SHANK_M)
    at_hip = _angle_opposite(np.full_like(length, _SHANK_M), _THIGH_M, length)
    forward = np.arcsin(reach[:, 0] / length)
    hip_x = np.arctan2(reach[:, 1], -reach[:, 2])
    hip_y = -forward - at_hip
    foot = base_from_foot[:, :3, :3]
    yaw = np.arctan2(foot[:, 1, 0], foot[:, 0, 0])
    pitch, roll = -np.arcsin(foot[:, 2, 0]), np.arctan2(foot[:, 2, 1], foot[:, 2, 2])
    return np.stack([yaw, hip_x, hip_y, knee, pitch - hip_y - knee, roll - hip_x], axis=1)


def _angle_opposite(
    opposite_m: FloatArray, side_m: FloatArray | float, other_m: FloatArray | float
) -> FloatArray:
    cosine = (side_m**2 + np.square(other_m) - opposite_m**2) / (2 * side_m * other_m)
    angle: FloatArray = np.arccos(np.clip(cosine, -1.0, 1.0))
    return angle

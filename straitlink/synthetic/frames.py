"""The tree of frames: map -> odom -> base_link -> torso -> head -> spindle -> lidar, and the cameras."""

from __future__ import annotations

import numpy as np

from straitlink.synthetic.gait import foot_poses, walking_pose
from straitlink.synthetic.joints import JOINT_NAMES, joint_positions, upper_body_positions
from straitlink.synthetic.rigid import (
    FloatArray,
    inverse,
    rotation_about,
    rotation_from_rpy,
    transform,
)

# 5 rpm, the rate at which Team MIT's spindle turned in use: 0.75 degrees between two scans, which at
# 2 m is 2.6 cm, just under the 3 cm cell of the terrain map, and a full view each half turn (6 s).
SPINDLE_RPM = 5.0
SPINDLE_RADPS = SPINDLE_RPM * 2 * np.pi / 60

_TORSO_M = (-0.01, 0.0, 0.22)
_HEAD_M = (0.12, 0.0, 0.55)
_SPINDLE_M = (0.06, 0.0, 0.06)
# x forward, y left, z up -> z forward, x right, y down (REP-103, suffix _optical).
BODY_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
_CHEST_PITCH_RAD = 0.45

SPINDLE_FROM_LIDAR = transform(np.eye(3), (0.03, 0.0, 0.02))
HEAD_FROM_HEAD_CAMERA = transform(BODY_FROM_OPTICAL, (0.08, 0.035, 0.0))
TORSO_FROM_CHEST_CAMERA = transform(rotation_about(1, _CHEST_PITCH_RAD) @ BODY_FROM_OPTICAL, (0.25, 0.0, 0.2))

STATIC_FRAMES: tuple[tuple[str, str, FloatArray], ...] = (
    ("spindle", "lidar", SPINDLE_FROM_LIDAR),
    ("head", "head_camera_optical_frame", HEAD_FROM_HEAD_CAMERA),
    ("torso", "chest_camera_optical_frame", TORSO_FROM_CHEST_CAMERA),
)
DYNAMIC_FRAMES: tuple[tuple[str, str], ...] = (
    ("map", "odom"),
    ("odom", "base_link"),
    ("base_link", "torso"),
    ("torso", "head"),
    ("head", "spindle"),
    ("base_link", "l_foot"),
    ("base_link", "r_foot"),
    ("torso", "l_hand"),
    ("torso", "r_hand"),
)

_BKZ, _BKY, _BKX, _NECK = (
    JOINT_NAMES.index(name) for name in ("back_bkz", "back_bky", "back_bkx", "neck_ry")
)


def spindle_angles(times_s: FloatArray) -> FloatArray:
    """(T,) radians about the head's x axis, not wrapped."""
    angles: FloatArray = SPINDLE_RADPS * times_s
    return angles


def dynamic_transforms(times_s: FloatArray, seed: int) -> FloatArray:
    """(T, 9, 4, 4) parent_from_child, in the order of DYNAMIC_FRAMES; exact, without noise."""
    positions = joint_positions(times_s, seed)
    map_from_base = walking_pose(times_s)
    map_from_odom = _odometry_drift(times_s)
    base_from_map = inverse(map_from_base)
    return np.stack(
        [
            map_from_odom,
            inverse(map_from_odom) @ map_from_base,
            _base_from_torso(positions),
            transform(rotation_about(1, positions[:, _NECK]), _HEAD_M),
            transform(rotation_about(0, spindle_angles(times_s)), _SPINDLE_M),
            base_from_map @ foot_poses(times_s, left=True),
            base_from_map @ foot_poses(times_s, left=False),
            _torso_from_hand(positions, left=True),
            _torso_from_hand(positions, left=False),
        ],
        axis=1,
    )


def map_from_torso(times_s: FloatArray, seed: int) -> FloatArray:
    """(T, 4, 4), exact."""
    poses: FloatArray = walking_pose(times_s) @ _base_from_torso(upper_body_positions(times_s, seed))
    return poses


def map_from_head(times_s: FloatArray, seed: int) -> FloatArray:
    """(T, 4, 4), exact."""
    positions = upper_body_positions(times_s, seed)
    torso_from_head = transform(rotation_about(1, positions[:, _NECK]), _HEAD_M)
    poses: FloatArray = walking_pose(times_s) @ _base_from_torso(positions) @ torso_from_head
    return poses


def map_from_lidar(times_s: FloatArray, seed: int) -> FloatArray:
    """(T, 4, 4), exact: the scanner turns with the spindle while the robot walks."""
    head_from_spindle = transform(rotation_about(0, spindle_angles(times_s)), _SPINDLE_M)
    poses: FloatArray = map_from_head(times_s, seed) @ head_from_spindle @ SPINDLE_FROM_LIDAR
    return poses


def _base_from_torso(positions_rad: FloatArray) -> FloatArray:
    rotation = (
        rotation_about(2, positions_rad[:, _BKZ])
        @ rotation_about(1, positions_rad[:, _BKY])
        @ rotation_about(0, positions_rad[:, _BKX])
    )
    return transform(rotation, _TORSO_M)


def _torso_from_hand(positions_rad: FloatArray, *, left: bool) -> FloatArray:
    """A hand that follows shoulder and elbow; not the arm's true chain (no lengths in our table)."""
    side = 1.0 if left else -1.0
    first = JOINT_NAMES.index("l_arm_shz" if left else "r_arm_shz")
    shoulder_z, elbow = positions_rad[:, first], positions_rad[:, first + 3] * side
    translation = np.stack(
        [0.35 + 0.1 * np.cos(elbow), side * 0.3 + 0.2 * shoulder_z, -0.1 + 0.2 * np.sin(elbow)], axis=-1
    )
    return transform(rotation_from_rpy(0.0, elbow - np.pi / 2, shoulder_z), translation)


def _odometry_drift(times_s: FloatArray) -> FloatArray:
    """(T, 4, 4) map_from_odom: what the estimator has drifted since the start, corrected now and then."""
    drift = 0.04 * np.sin(2 * np.pi * times_s / 71.0)
    yaw = 0.01 * np.sin(2 * np.pi * times_s / 53.0)
    return transform(rotation_about(2, yaw), np.stack([drift, -0.5 * drift, 0.0 * drift], axis=-1))

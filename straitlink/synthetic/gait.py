"""How the robot walks: along a corridor to the valve and back, stepping at 0.7 Hz."""

from __future__ import annotations

import numpy as np

from straitlink.synthetic.rigid import FloatArray, rotation_about, rotation_from_rpy, transform

STEP_RATE_HZ = 0.7  # one step of either foot; the body bobs at this rate
_CYCLE_RATE_HZ = STEP_RATE_HZ / 2
TRAVEL_M = 5.4  # from the start to where the valve is within reach of the eyes
TRAVEL_PERIOD_S = 90.0  # there and back; at most 0.19 m/s
BASE_HEIGHT_M = 0.80  # of the pelvis
ANKLE_HEIGHT_M = 0.08  # the frames l_foot and r_foot are at the ankles
_FOOT_OFFSET_M = 0.11
_BOB_M = 0.012
_SWAY_M = 0.03
_SWING_HEIGHT_M = 0.08
_STANCE_RATIO = 0.6  # of a foot's cycle on the ground
_MID_STANCE = _STANCE_RATIO / 2


def walking_pose(times_s: FloatArray) -> FloatArray:
    """(T, 4, 4) map_from_base: the way, with the bob, sway and pitch of walking on top."""
    x, y, yaw = _way(times_s)
    cycle = times_s * _CYCLE_RATE_HZ
    sway = _SWAY_M * np.cos(2 * np.pi * (cycle - _MID_STANCE))  # towards the foot that carries
    bob = _BOB_M * np.cos(4 * np.pi * (cycle - _MID_STANCE))
    roll = 0.015 * np.sin(2 * np.pi * cycle)
    pitch = 0.04 + 0.012 * np.sin(4 * np.pi * cycle)
    position = np.stack([x - sway * np.sin(yaw), y + sway * np.cos(yaw), BASE_HEIGHT_M + bob], axis=-1)
    return transform(rotation_from_rpy(roll, pitch, yaw), position)


def foot_poses(times_s: FloatArray, *, left: bool) -> FloatArray:
    """(T, 4, 4) map_from_foot: planted where the way is at mid-stance, swung smoothly to the next place."""
    phase = times_s * _CYCLE_RATE_HZ + (0.0 if left else 0.5)
    cycle = np.floor(phase)
    swing = np.clip((phase - cycle - _STANCE_RATIO) / (1 - _STANCE_RATIO), 0.0, 1.0)
    moved = swing**3 * (10 - 15 * swing + 6 * swing**2)  # starts and ends at rest, also in acceleration
    here = _planted(cycle, left=left)
    there = _planted(cycle + 1, left=left)
    x, y, yaw = (a + moved * (b - a) for a, b in zip(here, there, strict=True))
    height = ANKLE_HEIGHT_M + _SWING_HEIGHT_M * 64 * (swing * (1 - swing)) ** 3
    return transform(rotation_about(2, yaw), np.stack([x, y, height], axis=-1))


def stance_load_ratio(times_s: FloatArray, *, left: bool) -> FloatArray:
    """(T,) 0..1: the share of the weight on this foot; both feet add up to 1."""
    phase = np.mod(times_s * _CYCLE_RATE_HZ + (0.0 if left else 0.5), 1.0)
    shift = _STANCE_RATIO - 0.5  # the time of double support, at the begin and the end of stance
    rising = np.clip(phase / shift, 0.0, 1.0)
    falling = np.clip((_STANCE_RATIO - phase) / shift, 0.0, 1.0)
    load: FloatArray = np.minimum(rising, falling)
    return load


def _way(times_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """x, y, yaw of the way through the corridor: rests at both ends, looks about on the way."""
    x = TRAVEL_M / 2 * (1 - np.cos(2 * np.pi * times_s / TRAVEL_PERIOD_S))
    y = 0.1 * np.sin(2 * np.pi * times_s / 31.0)
    yaw = 0.25 * np.sin(2 * np.pi * times_s / 47.0)
    return x, y, yaw


def _planted(cycle: FloatArray, *, left: bool) -> tuple[FloatArray, FloatArray, FloatArray]:
    x, y, yaw = _way((cycle + _MID_STANCE - (0.0 if left else 0.5)) / _CYCLE_RATE_HZ)
    side = _FOOT_OFFSET_M if left else -_FOOT_OFFSET_M
    return x - side * np.sin(yaw), y + side * np.cos(yaw), yaw

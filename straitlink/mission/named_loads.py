"""Loads that have a name. Sizes of the synthetic mission's topics: docs/synthetic_mission.md."""

from __future__ import annotations

from typing import Any

Row = dict[str, Any]


def _row(name: str, direction: str, size: int, rate_hz: float, cls: str, max_hz: float | None = None) -> Row:
    return {
        "name": name,
        "direction": direction,
        "bytes": size,
        "rate_hz": rate_hz,
        "class": cls,
        "max_hz": max_hz,
    }


_OPERATOR: list[Row] = [
    _row("operator/heartbeat", "up", 64, 10, "heartbeat"),
    _row("operator/footstep_plan", "up", 600, 1 / 12, "command"),
    _row("operator/motion_plan", "up", 3000, 1 / 9, "command"),
    _row("operator/view_request", "up", 40, 1 / 4, "command"),
]

# What crosses of the synthetic mission, each topic at no more than 50 Hz. The head camera saturates
# the thin band; the fast band carries everything.
_LIGHT: list[Row] = [
    _row("robot/heartbeat", "down", 64, 10, "heartbeat"),
    _row("robot/joint_states", "down", 1000, 50, "state", 5),
    _row("robot/odometry", "down", 120, 50, "state", 5),
    _row("robot/force_torque/l_foot", "down", 80, 50, "state", 2),
    _row("robot/force_torque/r_foot", "down", 80, 50, "state", 2),
    _row("robot/process_status", "down", 4000, 1, "state", 0.1),
    _row("robot/height_map", "down", 8600, 0.5, "perception"),
    _row("robot/head_camera/overview", "down", 4900, 2, "perception"),
    _row("robot/head_camera/image", "down", 20_000, 2, "bulk"),
    *_OPERATOR,
]

# The load on which other stacks were measured too: a camera that asks for three times the thin band.
_CAMERA_FLOOD: list[Row] = [
    _row("robot/heartbeat", "down", 64, 10, "heartbeat"),
    _row("robot/joints", "down", 160, 20, "state"),
    _row("robot/image", "down", 20_000, 2, "perception"),
    _row("operator/command", "up", 80, 10, "command"),
]

# More than any link of ours carries, both ways: what an estimator is judged by.
_BACKLOGGED: list[Row] = [
    _row(f"{side}/{name}", way, size, rate_hz, cls)
    for side, way in (("robot", "down"), ("operator", "up"))
    for name, size, rate_hz, cls in (("heartbeat", 64, 10, "heartbeat"), ("flood", 10_000, 150, "perception"))
]

_CONTROL_HZ = 1000 / 3


def _wrench(limb: str) -> Row:
    return _row(f"robot/force_torque/{limb}", "down", 75, _CONTROL_HZ, "state", 2)


# Everything that the synthetic mission publishes, about 4,000 messages/s and 5 MB/s, under the rules of
# examples/robot.toml; most of it stays on the robot's bus or is decimated.
_FULL: list[Row] = [
    _row("robot/heartbeat", "down", 64, 10, "heartbeat"),
    _row("robot/joint_states", "down", 1129, _CONTROL_HZ, "state", 5),
    _row("robot/joint_commands", "down", 1129, _CONTROL_HZ, "none"),
    _row("robot/odometry", "down", 158, _CONTROL_HZ, "state", 5),
    _row("robot/tf", "down", 802, _CONTROL_HZ, "none"),
    _row("robot/tf_static", "down", 276, 1, "none"),
    _row("robot/imu", "down", 116, 1000, "none"),
    *(_wrench(limb) for limb in ("l_foot", "r_foot", "l_hand", "r_hand")),
    _row("robot/lidar/spindle", "down", 43, _CONTROL_HZ, "none"),
    _row("robot/lidar/scan", "down", 17_354, 40, "perception", 0.5),
    _row("robot/head_camera/image", "down", 140_425, 20, "perception", 2),
    _row("robot/head_camera/calibration", "down", 349, 1, "bulk", 0.02),
    _row("robot/chest_camera/image", "down", 56_717, 5, "perception", 2),
    _row("robot/chest_camera/calibration", "down", 347, 1, "bulk", 0.02),
    _row("robot/process_status", "down", 4141, 1, "state", 0.1),
    *_OPERATOR,
]

# The Finals: what must arrive crosses the thin link, what only the windows can carry goes round.
_FINALS: list[Row] = [
    _row("robot/heartbeat", "down", 64, 1, "heartbeat"),
    _row("robot/joint_states", "down", 60, 1, "state"),
    _row("robot/head_camera/image", "down", 140_425, 20, "carousel"),
    _row("robot/chest_camera/image", "down", 56_717, 5, "carousel"),
    _row("robot/lidar/scan", "down", 17_354, 40, "carousel"),
    _row("robot/joint_states_full", "down", 1129, _CONTROL_HZ, "carousel"),
    _row("operator/heartbeat", "up", 64, 1, "heartbeat"),
    _row("operator/footstep_plan", "up", 300, 1 / 12, "command"),
]

NAMED_LOADS: dict[str, list[Row]] = {
    "light": _LIGHT,
    "full": _FULL,
    "camera-flood": _CAMERA_FLOOD,
    "backlogged": _BACKLOGGED,
    "finals": _FINALS,
}

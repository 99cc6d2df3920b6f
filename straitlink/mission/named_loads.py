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

# The load of issue figures elsewhere: a camera that asks for more than three times the thin band.
_CAMERA_FLOOD: list[Row] = [
    _row("robot/heartbeat", "down", 64, 10, "heartbeat"),
    _row("robot/joints", "down", 160, 20, "state"),
    _row("robot/image", "down", 20_000, 2, "perception"),
    _row("operator/command", "up", 80, 10, "command"),
]

NAMED_LOADS: dict[str, list[Row]] = {"light": _LIGHT, "camera-flood": _CAMERA_FLOOD}

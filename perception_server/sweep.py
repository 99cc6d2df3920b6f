"""When a scanner on a spindle, or on a tilting axis, last saw all around."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from perception_server.frames import FloatArray
from perception_server.point_ring import BlockView
from perception_server.region import Window

HALF_TURN_RAD = np.deg2rad(183.0)  # and a little, so that the first and the last scan meet
MAX_SWEEP_NS = 20_000_000_000  # of a scanner that does not turn: what lies closer is "now"
_TURNING_RAD = np.deg2rad(0.02)  # between two scans; less is noise of a scanner at rest
_REVERSAL_RAD = np.deg2rad(5.0)  # turned back by this much: a new pass, not a jitter


def latest_sweep(views: tuple[BlockView, ...]) -> Window | None:
    """From now back to where the newest scan's plane has turned half way round, or passed there and back.

    A planar scanner has seen everything after half a turn. One that tilts to and fro has after a whole
    pass: the newest complete one and what has come since. None without scans.
    """
    start_ns, end_ns, axes = _newest_first(views)
    if start_ns.size == 0:
        return None
    newest_ns = int(end_ns[0])
    recent = start_ns >= newest_ns - MAX_SWEEP_NS
    start_ns, axes = start_ns[recent], axes[recent]
    turns = np.cross(axes[1:], axes[:-1])
    angles = np.arcsin(np.clip(np.linalg.norm(turns, axis=1), 0.0, 1.0))
    first = _first_of_sweep(turns, angles)
    return Window(int(start_ns[: first + 1].min()), newest_ns)


def _newest_first(
    views: tuple[BlockView, ...],
) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatArray]:
    """Start, end and plane of the scans of the newest scan's sensor."""
    empty = np.zeros(0, np.int64)
    parts = []
    sensor = None
    for view in reversed(views):
        block = view.block
        for index in range(view.stop - 1, view.first - 1, -1):
            sensor = sensor or block.sensors[index]
            if block.sensors[index] == sensor:
                parts.append((block, index))
        if parts and parts[-1][0].start_ns[parts[-1][1]] < parts[0][0].end_ns[parts[0][1]] - MAX_SWEEP_NS:
            break
    if not parts:
        return empty, empty, np.zeros((0, 3))
    return (
        np.array([block.start_ns[i] for block, i in parts]),
        np.array([block.end_ns[i] for block, i in parts]),
        np.array([block.axis[i] for block, i in parts]),
    )


def _first_of_sweep(turns: FloatArray, angles: FloatArray) -> int:
    """Index, counted back from the newest scan, of the sweep's first."""
    total, back, reversals = 0.0, 0.0, 0
    direction = np.zeros(3)
    turned_at = 0
    for index, angle in enumerate(angles.tolist()):
        if angle < _TURNING_RAD:
            continue
        turn = turns[index] / np.linalg.norm(turns[index])
        along = float(turn @ direction)
        if along >= 0:
            total, back = total + angle, 0.0
            # The axis moves with the robot; follow it.
            direction = direction * 0.9 + turn * 0.1 if direction.any() else turn
            if total >= HALF_TURN_RAD:
                return index + 1
        else:
            turned_at = index if back == 0.0 else turned_at
            back += angle
            if back >= _REVERSAL_RAD:
                reversals += 1
                if reversals == 2:
                    return turned_at
                direction, total, back = turn, back, 0.0
    return len(angles)

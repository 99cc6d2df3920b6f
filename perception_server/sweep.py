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
_NEAR_M = 1.5  # what lies nearer may fall into the seam of a sweep taken on the way
_MAX_OVERLAP_RAD = np.deg2rad(45.0)


def latest_sweep(views: tuple[BlockView, ...]) -> Window | None:
    """From now back to where the newest scan's plane has turned half way round, or passed there and back.

    A planar scanner has seen everything after half a turn, if it stood still. If it moved, its first and
    its last plane leave a wedge between them that neither passed, in which a plank can lie unseen over
    ground that was seen; so the sweep goes on by the angle of the way, seen from _NEAR_M. One that tilts
    to and fro has seen everything after a whole pass: the newest complete one and what has come since.
    None without scans.
    """
    start_ns, end_ns, axes, origins_m = _newest_first(views)
    if start_ns.size == 0:
        return None
    newest_ns = int(end_ns[0])
    recent = start_ns >= newest_ns - MAX_SWEEP_NS
    start_ns, axes, origins_m = start_ns[recent], axes[recent], origins_m[recent]
    turns = np.cross(axes[1:], axes[:-1])
    angles = np.arcsin(np.clip(np.linalg.norm(turns, axis=1), 0.0, 1.0))
    moved_m = np.linalg.norm(origins_m[1:] - origins_m[0], axis=1)
    overlaps = np.minimum(np.arctan(moved_m / _NEAR_M), _MAX_OVERLAP_RAD)
    first = _first_of_sweep(turns, angles, overlaps)
    return Window(int(start_ns[: first + 1].min()), newest_ns)


def _newest_first(
    views: tuple[BlockView, ...],
) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatArray, FloatArray]:
    """Start, end, plane and origin of the scans of the newest scan's sensor."""
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
        return empty, empty, np.zeros((0, 3)), np.zeros((0, 3))
    return (
        np.array([block.start_ns[i] for block, i in parts]),
        np.array([block.end_ns[i] for block, i in parts]),
        np.array([block.axis[i] for block, i in parts]),
        np.array([block.origin_m[i] for block, i in parts]),
    )


def _first_of_sweep(turns: FloatArray, angles: FloatArray, overlaps: FloatArray) -> int:
    """Index, counted back from the newest scan, of the sweep's first.

    overlaps: radians beyond half a turn that a sweep from each scan to the newest must have.
    """
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
            if total >= HALF_TURN_RAD + overlaps[index]:
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

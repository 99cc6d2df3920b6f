"""A history of the synthetic mission with its exact truth, without a log in between."""

from __future__ import annotations

from functools import cache

import numpy as np

from perception_server.frames import FloatArray, StampedTransform, compose, inverse_poses
from perception_server.history import History, HistorySnapshot
from perception_server.scan_geometry import RawScan, ScanPlacement
from straitlink.synthetic.frames import map_from_head, map_from_lidar
from straitlink.synthetic.lidar import SCAN_PERIOD_S, BoxField, Rays, Scanner
from straitlink.synthetic.rigid import quaternion_from_rotation
from straitlink.synthetic.scene import build_scene
from straitlink.synthetic.settings import START_NS

SWEEP_S = 6.2  # half a turn of the spindle, and a little
BEAM_NS = SCAN_PERIOD_S / 1440 * 1e9
_POSE_PERIOD_S = 0.003


def rows_of(matrices: FloatArray) -> FloatArray:
    """(T, 7) of (T, 4, 4)."""
    return np.concatenate([matrices[:, :3, 3], quaternion_from_rotation(matrices[:, :3, :3])], axis=1)


def transforms(start_s: float, end_s: float, seed: int) -> list[StampedTransform]:
    """map <- head <- lidar as /tf would bring them."""
    times_s = np.arange(start_s - 2 * _POSE_PERIOD_S, end_s + 2 * _POSE_PERIOD_S, _POSE_PERIOD_S)
    head = rows_of(map_from_head(times_s, seed))
    head_from_lidar = compose(inverse_poses(head), rows_of(map_from_lidar(times_s, seed)))
    samples = []
    for time_s, first, second in zip(times_s.tolist(), head.tolist(), head_from_lidar.tolist(), strict=True):
        stamp_ns = START_NS + round(time_s * 1e9)
        samples.append(StampedTransform(stamp_ns, "map", "head", tuple(first)))
        samples.append(StampedTransform(stamp_ns, "head", "lidar", tuple(second)))
    return samples


def scan_at(scanner: Scanner, start_s: float) -> RawScan:
    """The next scan of a scanner, as its driver would publish it."""
    angles = scanner.angles_rad
    return RawScan(
        "robot/lidar/scan",
        "lidar",
        START_NS + round(start_s * 1e9),
        BEAM_NS,
        float(angles[0]),
        float(angles[1] - angles[0]),
        scanner.scan(start_s).ranges_m.astype(np.float32),
        0.1,
        30.0,
    )


def record(seed: int, start_s: float, duration_s: float) -> History:
    """What a history holds after so long."""
    history = History(placement=ScanPlacement(sweep_frame="head"))
    scanner = Scanner(build_scene(seed), seed)
    for index in range(round(duration_s / SCAN_PERIOD_S)):
        at_s = start_s + index * SCAN_PERIOD_S
        history.insert_transforms(transforms(at_s, at_s + SCAN_PERIOD_S, seed), 0)
        history.insert_scan(scan_at(scanner, at_s), 0)
    return history


@cache
def one_sweep(seed: int = 1, start_s: float = 24.0) -> HistorySnapshot:
    """The last 6.2 s before start_s + 6.2 s, all of them scans of one half turn."""
    return record(seed, start_s, SWEEP_S).snapshot()


def true_ranges(seed: int, origins_m: FloatArray, directions: FloatArray) -> FloatArray:
    """(N,) distance to the scene along unit directions in the frame `map`; +inf for a miss."""
    field = BoxField(build_scene(seed))
    parts = [
        field.cast(Rays(origins_m[i : i + 20_000], directions[i : i + 20_000]))[0]
        for i in range(0, len(origins_m), 20_000)
    ]
    return np.concatenate(parts)

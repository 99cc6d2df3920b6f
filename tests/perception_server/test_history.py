"""The history: late poses, bounds, order, snapshots."""

from __future__ import annotations

import numpy as np
import pytest

from perception_server.errors import PerceptionError
from perception_server.frames import StampedTransform
from perception_server.history import History, HistoryLimits
from perception_server.pictures import CameraFrame
from perception_server.point_ring import MIXED, ON_ROBOT
from perception_server.scan_geometry import RawCloud, RawScan, ScanPlacement, SelfBox

S = 1_000_000_000
MS = 1_000_000


def base_at(stamp_ns: int, x_m: float = 0.0) -> StampedTransform:
    return StampedTransform(stamp_ns, "map", "lidar", (x_m, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))


def scan(start_ns: int, ranges: list[float] | None = None, beam_period_ns: float = 0.0) -> RawScan:
    values = np.array(ranges or [1.0, 2.0, 3.0], dtype=np.float32)
    return RawScan("scan", "lidar", start_ns, beam_period_ns, 0.0, 0.0, values, 0.1, 30.0)


def world_points(history: History) -> np.ndarray:
    parts = []
    for view in history.snapshot().scans:
        block = view.block
        for i in range(view.first, view.stop):
            rows = slice(int(block.first_point[i]), int(block.first_point[i + 1]))
            parts.append(block.points_m[rows] + block.origin_m[i])
    return np.concatenate(parts) if parts else np.empty((0, 3))


def test_each_beam_is_placed_from_the_pose_at_its_own_instant() -> None:
    history = History()
    history.insert_transforms([base_at(S, 0.0), base_at(2 * S, 10.0)], 0)
    history.insert_scan(scan(S, [1.0, 1.0, 1.0], beam_period_ns=S / 4), 0)
    np.testing.assert_allclose(world_points(history)[:, 0], [1.0, 3.5, 6.0], atol=1e-5)


def test_a_robot_far_from_the_worlds_origin_loses_no_precision() -> None:
    history = History()
    history.insert_transforms([base_at(S, 5e6), base_at(2 * S, 5e6)], 0)
    history.insert_scan(scan(S, [1.2345]), 0)
    assert world_points(history)[0, 0] - 5e6 == pytest.approx(1.2345, abs=1e-6)


def test_a_scan_waits_for_its_poses() -> None:
    history = History()
    history.insert_transforms([base_at(S)], 0)
    history.insert_scan(scan(S + 1, beam_period_ns=MS), 0)
    assert history.waiting == 1 and not history.snapshot().scans
    history.insert_transforms([base_at(S + 100 * MS)], 0)
    assert history.waiting == 0 and len(world_points(history)) == 3


def test_a_scan_whose_poses_never_come_is_counted_and_dropped() -> None:
    history = History(HistoryLimits(pose_wait_s=1.0))
    history.insert_transforms([base_at(5 * S)], 0)
    history.insert_scan(scan(4 * S), 0)  # before the first pose: none will come
    assert (history.waiting, history.counters.without_pose) == (0, 1)
    history.insert_scan(scan(6 * S), 0)
    history.settle(S)
    assert history.waiting == 1
    history.settle(S + 1)
    assert (history.waiting, history.counters.without_pose) == (0, 2)


def test_no_more_scans_wait_than_allowed() -> None:
    history = History(HistoryLimits(max_waiting=3))
    for i in range(10):
        history.insert_scan(scan(S + i), 0)
    assert (history.waiting, history.counters.overflowed) == (3, 7)


def test_old_scans_go_by_age_and_by_count_in_order_of_time() -> None:
    history = History(HistoryLimits(duration_s=10, max_scan_points=100))
    history.insert_transforms([base_at(0)], 0)
    for t in range(1, 60):
        history.insert_transforms([base_at(t * S + S // 2)], 0)
        history.insert_scan(scan(t * S), 0)
    views = history.snapshot().scans
    starts = np.concatenate([v.block.start_ns[v.first : v.stop] for v in views])
    assert starts.tolist() == [t * S for t in range(49, 60)]
    for i in range(200):
        history.insert_scan(scan(59 * S + i), 0)
    assert sum(v.points for v in history.snapshot().scans) == 99


def test_a_snapshot_does_not_see_later_scans() -> None:
    history = History()
    history.insert_transforms([base_at(0), base_at(2 * S)], 0)
    history.insert_scan(scan(S), 0)
    before = history.snapshot()
    for _ in range(1000):
        history.insert_scan(scan(S), 0)
    assert sum(v.points for v in before.scans) == 3
    assert sum(v.points for v in history.snapshot().scans) == 3003


def test_no_return_is_no_point_and_doubtful_returns_are_marked() -> None:
    placement = ScanPlacement(self_boxes=(SelfBox("lidar", (0, -1, -1), (0.5, 1, 1)),))
    history = History(placement=placement)
    history.insert_transforms([base_at(0), base_at(2 * S)], 0)
    ranges = [np.inf, -np.inf, np.nan, 0.05, 40.0, 0.3, 5.0, 5.0, 4.0, 3.0, 3.0]
    values = np.array(ranges, dtype=np.float32)
    history.insert_scan(RawScan("scan", "lidar", S, 0, 0.0, 0.004, values, 0.1, 30.0), 0)
    block = history.snapshot().scans[0].block
    assert block.flags[:6].tolist() == [ON_ROBOT, 0, 0, MIXED, 0, 0]
    assert len(world_points(history)) == 6


def test_a_large_cloud_has_a_block_of_its_own() -> None:
    history = History()
    history.insert_transforms([base_at(0, 1.0), base_at(2 * S, 1.0)], 0)
    points = np.zeros((100_000, 3), dtype=np.float32)
    points[7] = np.nan
    history.insert_cloud(RawCloud("depth", "lidar", S, points), 0)
    history.insert_cloud(RawCloud("depth", "lidar", S, points[:10]), 0)
    assert [v.points for v in history.snapshot().clouds] == [99_999, 9]


def test_pictures_are_bounded_by_bytes_and_by_age() -> None:
    history = History(HistoryLimits(duration_s=10, max_picture_bytes=1000))
    for t in range(30):
        history.insert_image(CameraFrame("head", "optical", t * S, "jpeg", bytes(100)))
    assert [f.capture_ns // S for f in history.snapshot().cameras["head"]] == list(range(20, 30))
    history.insert_image(CameraFrame("chest", "optical", 29 * S + 1, "jpeg", bytes(950)))
    assert list(history.snapshot().cameras) == ["chest"]
    history.insert_image(CameraFrame("chest", "optical", 28 * S, "jpeg", bytes(10)))
    assert [f.capture_ns // S for f in history.snapshot().cameras["chest"]] == [28, 29]
    history.insert_image(CameraFrame("chest", "optical", 30 * S, "jpeg", bytes(2000)))
    assert not history.snapshot().cameras


def test_a_limit_out_of_bounds_is_named() -> None:
    with pytest.raises(PerceptionError, match=r"history.duration_s = 0: must be within 1..3600"):
        HistoryLimits(duration_s=0)

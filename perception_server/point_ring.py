"""Points of the last while in the world frame: append-only blocks, so that a snapshot costs nothing.

A scan's points are kept in float32 relative to an origin of their own in float64 (where the sensor was),
so that a robot far from the world's origin loses no precision. Blocks are filled once and never changed
below their end: readers in other threads need no lock, and a render passes through memory in order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception_server.frames import FloatArray

BLOCK_POINTS = 65_536
BLOCK_SCANS = 512
RUN_POINTS = 64  # neighbours in a scan share a bounding box, by which a render passes over them

ON_ROBOT = 1  # flag: the return is on the robot itself
MIXED = 2  # flag: it hangs between two surfaces, as the beam's edge met both

FloatPoints = NDArray[np.float32]
Flags = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class PlacedScan:
    """One scan or cloud, placed: points (N, 3) float32 relative to origin_m (3,), both in the world frame.

    start_ns, end_ns: capture times of its first and last point. flags: (N,), ON_ROBOT | MIXED.
    axis: (3,) the scan plane's normal in the frame against which sweeps are told; zeros for a cloud.
    """

    sensor: str
    start_ns: int
    end_ns: int
    origin_m: FloatArray
    points_m: FloatPoints
    flags: Flags
    axis: FloatArray


class PointBlock:
    """Storage for up to `points` points of up to `scans` scans."""

    def __init__(self, points: int, scans: int) -> None:
        runs = points // RUN_POINTS + scans + 1
        self.points_m: FloatPoints = np.empty((points, 3), dtype=np.float32)
        self.flags: Flags = np.empty(points, dtype=np.uint8)
        self.first_point = np.zeros(scans + 1, dtype=np.int64)  # of each scan; the next one's is its end
        self.first_run = np.zeros(scans + 1, dtype=np.int64)
        self.run_bounds_m: FloatPoints = np.empty((runs, 6), dtype=np.float32)  # min x, y, z, max x, y, z
        self.start_ns = np.zeros(scans, dtype=np.int64)
        self.end_ns = np.zeros(scans, dtype=np.int64)
        self.origin_m: FloatArray = np.zeros((scans, 3))
        self.axis: FloatArray = np.zeros((scans, 3))
        self.sensors: list[str] = []

    @property
    def scans(self) -> int:
        """How many scans it holds."""
        return len(self.sensors)

    def has_room(self, points: int) -> bool:
        """Whether one more scan of so many points fits."""
        used = int(self.first_point[self.scans])
        return self.scans < self.start_ns.size and used + points <= self.flags.size

    def append(self, scan: PlacedScan) -> None:
        """Write a scan behind the last one."""
        index, count = self.scans, len(scan.points_m)
        first = int(self.first_point[index])
        self.points_m[first : first + count] = scan.points_m
        self.flags[first : first + count] = scan.flags
        starts = np.arange(0, count, RUN_POINTS)
        run = int(self.first_run[index])
        if count:
            bounds = self.run_bounds_m[run : run + starts.size]
            np.minimum.reduceat(scan.points_m, starts, axis=0, out=bounds[:, :3])
            np.maximum.reduceat(scan.points_m, starts, axis=0, out=bounds[:, 3:])
        self.start_ns[index], self.end_ns[index] = scan.start_ns, scan.end_ns
        self.origin_m[index], self.axis[index] = scan.origin_m, scan.axis
        self.first_point[index + 1] = first + count
        self.first_run[index + 1] = run + starts.size
        self.sensors.append(scan.sensor)


@dataclass(frozen=True, slots=True)
class BlockView:
    """The scans first..stop-1 of a block, as they were when the snapshot was taken."""

    block: PointBlock
    first: int
    stop: int

    @property
    def points(self) -> int:
        """How many points these scans have."""
        return int(self.block.first_point[self.stop] - self.block.first_point[self.first])


class PointRing:
    """Scans in order of arrival, the oldest dropped by age and by number of points.

    `views` is replaced, never changed: take the reference and read at leisure.
    """

    def __init__(self, max_points: int, max_age_ns: int) -> None:
        self._max_points = max_points
        self._max_age_ns = max_age_ns
        self._points = 0
        self.newest_ns = 0
        self.views: tuple[BlockView, ...] = ()

    def append(self, scan: PlacedScan) -> int:
        """Keep a scan; returns how many older ones were dropped for it."""
        count = len(scan.points_m)
        if not self.views or not self.views[-1].block.has_room(count):
            small = count <= BLOCK_POINTS
            block = PointBlock(BLOCK_POINTS if small else count, BLOCK_SCANS if small else 1)
            self.views = (*self.views, BlockView(block, 0, 0))
        *earlier, last = self.views
        last.block.append(scan)
        self.views = (*earlier, BlockView(last.block, last.first, last.block.scans))
        self._points += count
        self.newest_ns = max(self.newest_ns, scan.end_ns)
        return self._drop()

    def _drop(self) -> int:
        dropped = 0
        views = list(self.views)
        while views:
            oldest = views[0]
            if oldest.first == oldest.stop:
                if len(views) == 1:
                    break
                views.pop(0)
                continue
            block, index = oldest.block, oldest.first
            too_old = block.end_ns[index] < self.newest_ns - self._max_age_ns
            if not too_old and self._points <= self._max_points:
                break
            self._points -= int(block.first_point[index + 1] - block.first_point[index])
            views[0] = BlockView(block, index + 1, oldest.stop)
            dropped += 1
        if dropped:
            self.views = tuple(views)
        return dropped

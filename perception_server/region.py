"""Which points a view shows: a time window, a box and half-planes in the view's frame, a band of ranges."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from perception_server.compiled import compiled
from perception_server.frames import FloatArray
from perception_server.point_ring import BlockView

OUTSIDE, CROSSING, INSIDE = 0, 1, 2


@dataclass(frozen=True, slots=True)
class Window:
    """Capture times start_ns..end_ns, both included, of a scan's middle."""

    start_ns: int
    end_ns: int


@dataclass(frozen=True, slots=True)
class Region:
    """Which points: all conditions must hold.

    view_from_world: (4, 4). low_m, high_m: the box in the view's frame. half_planes: (P, 4), kept where
    n . p + d >= 0. min_range_m, max_range_m: from where the sensor was. rejected_flags: see point_ring.
    """

    view_from_world: FloatArray
    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]
    half_planes: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))
    min_range_m: float = 0.0
    max_range_m: float = np.inf
    rejected_flags: int = 0

    def planes(self) -> NDArray[np.float32]:
        """(6 + P, 4): the box and the half-planes as one list."""
        rows = []
        for axis in range(3):
            normal = np.zeros(3)
            normal[axis] = 1.0
            rows.append([*normal, -self.low_m[axis]])
            rows.append([*-normal, self.high_m[axis]])
        return np.array([*rows, *self.half_planes.tolist()], dtype=np.float32)


@dataclass(frozen=True, slots=True)
class ViewPoints:
    """The points of a region, in the view's frame, in the order in which they were taken.

    points_m: (N, 3) float32. sensors_m: (N,) index into origins_m (S, 3), where each one's sensor was.
    sources: how many scans or clouds lie in the window. start_ns..end_ns: what these span.
    """

    points_m: NDArray[np.float32]
    sources: int
    start_ns: int
    end_ns: int


def collect(views: tuple[BlockView, ...], window: Window, region: Region) -> ViewPoints:
    """Every point of the region; one pass through memory, whole runs of neighbours taken or left at once."""
    picked = [(view, _scans_within(view, window)) for view in views]
    picked = [(view, scans) for view, scans in picked if scans.size]
    points = sum(_point_count(view, scans) for view, scans in picked)
    out = np.empty((points, 3), dtype=np.float32)
    rotation = np.ascontiguousarray(region.view_from_world[:3, :3])
    planes = region.planes()
    count = 0
    for view, scans in picked:
        block = view.block
        origins = (block.origin_m[scans] @ rotation.T + region.view_from_world[:3, 3]).astype(np.float32)
        count = _collect_block(
            block.points_m,
            block.flags,
            block.first_point,
            block.first_run,
            block.run_bounds_m,
            scans,
            origins,
            rotation.astype(np.float32),
            planes,
            np.float32(region.min_range_m) ** 2,
            np.float32(region.max_range_m) ** 2,
            region.rejected_flags,
            out,
            count,
        )
    starts = [int(view.block.start_ns[scans].min()) for view, scans in picked]
    ends = [int(view.block.end_ns[scans].max()) for view, scans in picked]
    return ViewPoints(
        out[:count],
        sum(scans.size for _, scans in picked),
        min(starts, default=0),
        max(ends, default=0),
    )


def _scans_within(view: BlockView, window: Window) -> NDArray[np.intp]:
    rows = slice(view.first, view.stop)
    middle_ns = view.block.start_ns[rows] + (view.block.end_ns[rows] - view.block.start_ns[rows]) // 2
    return np.flatnonzero((middle_ns >= window.start_ns) & (middle_ns <= window.end_ns)) + view.first


def _point_count(view: BlockView, scans: NDArray[np.intp]) -> int:
    first = view.block.first_point
    return int((first[scans + 1] - first[scans]).sum())


@compiled
def _collect_block(
    points,
    flags,
    first_point,
    first_run,
    run_bounds,
    scans,
    origins,
    rotation,
    planes,
    min_range2,
    max_range2,
    rejected,
    out,
    count,
):
    r00, r01, r02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    r10, r11, r12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    r20, r21, r22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    half = np.float32(0.5)
    all_ranges = min_range2 <= 0 and max_range2 == np.inf
    for s in range(scans.size):
        scan = scans[s]
        ox, oy, oz = origins[s, 0], origins[s, 1], origins[s, 2]
        first, last = first_point[scan], first_point[scan + 1]
        for run in range(first_run[scan], first_run[scan + 1]):
            begin = first + (run - first_run[scan]) * 64
            end = min(begin + 64, last)
            cx = half * (run_bounds[run, 0] + run_bounds[run, 3])
            cy = half * (run_bounds[run, 1] + run_bounds[run, 4])
            cz = half * (run_bounds[run, 2] + run_bounds[run, 5])
            hx, hy, hz = run_bounds[run, 3] - cx, run_bounds[run, 4] - cy, run_bounds[run, 5] - cz
            vx = r00 * cx + r01 * cy + r02 * cz + ox
            vy = r10 * cx + r11 * cy + r12 * cz + oy
            vz = r20 * cx + r21 * cy + r22 * cz + oz
            ex = abs(r00) * hx + abs(r01) * hy + abs(r02) * hz
            ey = abs(r10) * hx + abs(r11) * hy + abs(r12) * hz
            ez = abs(r20) * hx + abs(r21) * hy + abs(r22) * hz
            outside = False
            inside = True
            for p in range(len(planes)):
                distance = planes[p, 0] * vx + planes[p, 1] * vy + planes[p, 2] * vz + planes[p, 3]
                reach = abs(planes[p, 0]) * ex + abs(planes[p, 1]) * ey + abs(planes[p, 2]) * ez
                if distance < -reach:
                    outside = True
                    break
                if distance < reach:
                    inside = False
            if outside:
                continue
            for i in range(begin, end):
                if flags[i] & rejected:
                    continue
                px, py, pz = points[i, 0], points[i, 1], points[i, 2]
                if not all_ranges:
                    range2 = px * px + py * py + pz * pz
                    if range2 < min_range2 or range2 > max_range2:
                        continue
                x = r00 * px + r01 * py + r02 * pz + ox
                y = r10 * px + r11 * py + r12 * pz + oy
                z = r20 * px + r21 * py + r22 * pz + oz
                kept = True
                if not inside:
                    for p in range(len(planes)):
                        if planes[p, 0] * x + planes[p, 1] * y + planes[p, 2] * z + planes[p, 3] < 0:
                            kept = False
                            break
                if kept:
                    out[count, 0] = x
                    out[count, 1] = y
                    out[count, 2] = z
                    count += 1
    return count

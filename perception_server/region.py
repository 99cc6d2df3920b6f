"""Which points a view shows: a time window, a box and half-planes in the view's frame, a band of ranges."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from perception_server.compiled import compiled
from perception_server.frames import FloatArray
from perception_server.point_ring import RUN_POINTS, BlockView

OUTSIDE = -1


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

    points_m: (N, 3) float32. sources: how many scans, clouds or disparity images lie in the window (S).
    start_ns..end_ns: what these span; 0 without any. origins_m: (S, 3) float32, where the sensor was.
    stops: (S,) int64, where in points_m each one's points end.
    """

    points_m: NDArray[np.float32]
    sources: int
    start_ns: int
    end_ns: int
    origins_m: NDArray[np.float32]
    stops: NDArray[np.int64]


def collect(views: tuple[BlockView, ...], window: Window, region: Region) -> ViewPoints:
    """Every point of the region; one pass through memory, whole runs of neighbours taken or left at once."""
    picked = [(view, _scans_within(view, window)) for view in views]
    picked = [(view, scans) for view, scans in picked if scans.size]
    points = sum(_point_count(view, scans) for view, scans in picked)
    out = np.empty((points, 3), dtype=np.float32)
    rotation = np.ascontiguousarray(region.view_from_world[:3, :3])
    planes = region.planes()
    range2 = np.array([region.min_range_m, region.max_range_m], dtype=np.float32) ** 2
    origins_m = np.empty((sum(scans.size for _, scans in picked), 3), dtype=np.float32)
    stops = np.empty(len(origins_m), dtype=np.int64)
    count = done = 0
    for view, scans in picked:
        block, rows = view.block, slice(done, done + scans.size)
        origins_m[rows] = block.origin_m[scans] @ rotation.T + region.view_from_world[:3, 3]
        count = _collect_block(
            block.points_m,
            block.flags,
            block.first_point,
            block.first_run,
            block.run_bounds_m,
            scans,
            origins_m[rows],
            rotation.astype(np.float32),
            planes,
            range2,
            region.rejected_flags,
            out,
            count,
            stops[rows],
        )
        done += scans.size
    starts = [int(view.block.start_ns[scans].min()) for view, scans in picked]
    ends = [int(view.block.end_ns[scans].max()) for view, scans in picked]
    return ViewPoints(out[:count], done, min(starts, default=0), max(ends, default=0), origins_m, stops)


def _scans_within(view: BlockView, window: Window) -> NDArray[np.intp]:
    rows = slice(view.first, view.stop)
    middle_ns = view.block.start_ns[rows] + (view.block.end_ns[rows] - view.block.start_ns[rows]) // 2
    return np.flatnonzero((middle_ns >= window.start_ns) & (middle_ns <= window.end_ns)) + view.first


def _point_count(view: BlockView, scans: NDArray[np.intp]) -> int:
    first = view.block.first_point
    return int((first[scans + 1] - first[scans]).sum())


@compiled
def _collect_block(
    points: NDArray[np.float32],
    flags: NDArray[np.uint8],
    first_point: NDArray[np.int64],
    first_run: NDArray[np.int64],
    run_bounds: NDArray[np.float32],
    scans: NDArray[np.intp],
    origins: NDArray[np.float32],
    rotation: NDArray[np.float32],
    planes: NDArray[np.float32],
    range2: NDArray[np.float32],
    rejected: int,
    out: NDArray[np.float32],
    count: int,
    stops: NDArray[np.int64],
) -> int:
    """Append a block's points of the region to out (N, 3) at count; returns the new count.

    scans: which; origins (len(scans), 3): their origins in the view's frame. range2 (2,): bounds squared.
    stops (len(scans),): filled with the count after each.
    """
    # Scalars: from arrays they would be read anew for each point, as far as the compiler can tell.
    xx, xy, xz = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    yx, yy, yz = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    zx, zy, zz = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    least2, most2 = range2[0], range2[1]
    all_ranges = least2 <= 0 and most2 == np.inf
    crossed = np.empty_like(planes)  # the first ones: those that pass through the present run
    for s in range(scans.size):
        scan = scans[s]
        ox, oy, oz = origins[s, 0], origins[s, 1], origins[s, 2]
        for run in range(first_run[scan], first_run[scan + 1]):
            crossing = _cross_run(run_bounds[run], rotation, ox, oy, oz, planes, crossed)
            if crossing == OUTSIDE:
                continue
            begin = first_point[scan] + (run - first_run[scan]) * RUN_POINTS
            for i in range(begin, min(begin + RUN_POINTS, first_point[scan + 1])):
                px, py, pz = points[i, 0], points[i, 1], points[i, 2]
                x = xx * px + xy * py + xz * pz + ox
                y = yx * px + yy * py + yz * pz + oy
                z = zx * px + zy * py + zz * pz + oz
                # Written first and kept after: a branch that depends on each point costs more.
                out[count, 0], out[count, 1], out[count, 2] = x, y, z
                kept = (flags[i] & rejected) == 0
                if not all_ranges:
                    squared = px * px + py * py + pz * pz
                    kept &= (squared >= least2) & (squared <= most2)
                for p in range(crossing):
                    away = crossed[p, 0] * x + crossed[p, 1] * y + crossed[p, 2] * z + crossed[p, 3]
                    kept &= away >= 0
                count += kept
        stops[s] = count
    return count


@compiled
def _cross_run(
    bounds: NDArray[np.float32],
    r: NDArray[np.float32],
    ox: float,
    oy: float,
    oz: float,
    planes: NDArray[np.float32],
    crossed: NDArray[np.float32],
) -> int:
    """How many planes pass through a run's bounding box, into crossed; OUTSIDE if it lies beyond one.

    Its points are on the right side of all others.
    """
    half = np.float32(0.5)
    cx, cy, cz = (
        half * (bounds[0] + bounds[3]),
        half * (bounds[1] + bounds[4]),
        half * (bounds[2] + bounds[5]),
    )
    hx, hy, hz = bounds[3] - cx, bounds[4] - cy, bounds[5] - cz
    x = r[0, 0] * cx + r[0, 1] * cy + r[0, 2] * cz + ox
    y = r[1, 0] * cx + r[1, 1] * cy + r[1, 2] * cz + oy
    z = r[2, 0] * cx + r[2, 1] * cy + r[2, 2] * cz + oz
    ex = abs(r[0, 0]) * hx + abs(r[0, 1]) * hy + abs(r[0, 2]) * hz
    ey = abs(r[1, 0]) * hx + abs(r[1, 1]) * hy + abs(r[1, 2]) * hz
    ez = abs(r[2, 0]) * hx + abs(r[2, 1]) * hy + abs(r[2, 2]) * hz
    count = 0
    for p in range(len(planes)):
        distance = planes[p, 0] * x + planes[p, 1] * y + planes[p, 2] * z + planes[p, 3]
        reach = abs(planes[p, 0]) * ex + abs(planes[p, 1]) * ey + abs(planes[p, 2]) * ez
        # A thousandth of a millimetre: float32 rounds, and a point on the border is tested itself.
        if distance < -reach - 1e-6:
            return OUTSIDE
        if distance < reach + 1e-6:
            crossed[count] = planes[p]
            count += 1
    return count

"""Views against the truth: `python -m bench.perception_accuracy [--seeds 16] [--json]`.

The synthetic mission's scanner walks for 20 s, so that each view has the window that it asks for; whole
views of every seed are judged by rays through the exact scene. A cell (pixel) is judged by its error where
the truth varies by less than 3 cm within it, else by whether it lies between the cell's bounds +-3 cm; a
cloud by how far its points lie from the returns, an octree by the returns that it leaves out.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict, dataclass, fields

import numpy as np
from numpy.typing import NDArray

from bench.machine import keep
from bench.perception import PLENTY, fill_history, poses, synthetic_scans
from bench.scene_truth import true_ranges
from messages.proto.straitlink.view_pb2 import ViewRequest
from perception_server.answer import answer, look
from perception_server.compiled import compiled
from perception_server.decode import DecodedView, decode_view, grid_of
from perception_server.frames import FloatArray
from perception_server.height_map import Grid
from perception_server.history import HistorySnapshot
from perception_server.range_map import Projection
from perception_server.view_wish import view_wish

END_S, HISTORY_S = 30.2, 20.2
FLAT_M = 0.03  # cells whose truth varies less are judged by their error, the others by their bounds
MET_M = 0.05  # a return within this of a cell's true surface is one of it
MOST_RMSE_MM, MOST_P95_MM = 12.0, 20.0


@dataclass(frozen=True, slots=True)
class MapAccuracy:
    """A height map or range map of one seed.

    cells: judged by their error. beyond_100_mm: those that are off by more. rmse_met_mm: of those whose true
    surface one of their own returns met; unmet: how many others there are, which show what was seen beneath
    it. edges_within: share of the other cells between their true bounds +-3 cm. shown: share of the cells
    with returns that are no holes (of range maps not counted: 1).
    """

    view: str
    seed: int
    cells: int
    rmse_mm: float
    p95_mm: float
    beyond_100_mm: int
    rmse_met_mm: float
    unmet: int
    edges_within: float
    shown: float

    @property
    def holds(self) -> bool:
        """Whether it is as true as views must be."""
        return self.rmse_mm <= MOST_RMSE_MM and self.p95_mm <= MOST_P95_MM


@dataclass(frozen=True, slots=True)
class SolidAccuracy:
    """A cloud or octree of one seed.

    sent, returns: points or leaves in the view, points in its window. stated_mm, farthest_mm: the view's
    maximum error; how far the worst of a cloud's points is from the nearest return. left_out: returns that
    lie in no leaf of an octree.
    """

    view: str
    seed: int
    sent: int
    returns: int
    stated_mm: float
    farthest_mm: float
    left_out: int

    @property
    def holds(self) -> bool:
        """Whether it keeps what it states."""
        return self.farthest_mm <= self.stated_mm + 0.001 and self.left_out == 0


Accuracy = MapAccuracy | SolidAccuracy


def accuracy(seed: int) -> list[Accuracy]:
    """All four kinds of views of one seed."""
    start_s = END_S - HISTORY_S
    scans = synthetic_scans(seed, start_s, HISTORY_S, fill=False)
    history, _ = fill_history(scans, poses(seed, start_s, HISTORY_S))
    snapshot = history.snapshot()
    return [
        height_accuracy(snapshot, seed),
        range_accuracy(snapshot, seed),
        cloud_accuracy(snapshot, seed),
        octree_accuracy(snapshot, seed),
    ]


def shown_by(request: ViewRequest, snapshot: HistorySnapshot) -> DecodedView:
    """The view as an operator has it."""
    return decode_view(answer(request, snapshot, PLENTY).SerializeToString())


def height_accuracy(snapshot: HistorySnapshot, seed: int) -> MapAccuracy:
    """The preset's height map, of the cells with returns."""
    request = ViewRequest(preset="height_map_scene")
    view = shown_by(request, snapshot)
    low, high = height_bounds(view, seed)
    wish = view_wish(request)
    returns, met = _returns(look(wish, snapshot).points.points_m, grid_of(view), low, high)
    assert view.values is not None
    judged = returns & (high < wish.high_m[2])
    values = view.values[judged].astype(np.float64)
    return _judged("height_map_scene", seed, values, low[judged], high[judged], met[judged])


def _returns(
    points_m: NDArray[np.float32], grid: Grid, low: FloatArray, high: FloatArray
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which cells (rows, columns) have returns, and which have one of their true surface."""
    column, row = (
        np.floor((points_m[:, axis] - first) / grid.resolution_m).astype(int)
        for axis, first in enumerate((grid.min_x_m, grid.min_y_m))
    )
    inside = (column >= 0) & (column < grid.columns) & (row >= 0) & (row < grid.rows)
    column, row, z = column[inside], row[inside], points_m[inside, 2]
    returns, met = np.zeros(low.shape, np.bool_), np.zeros(low.shape, np.bool_)
    returns[row, column] = True
    on_it = (z > low[row, column] - MET_M) & (z < high[row, column] + MET_M)
    met[row[on_it], column[on_it]] = True
    return returns, met


def height_bounds(view: DecodedView, seed: int) -> tuple[FloatArray, FloatArray]:
    """The scene's lowest and highest point in each cell of a height map, by nine rays from above.

    (rows, columns) each, metres along the view's z; the view's x and y must be level.
    """
    grid = grid_of(view)
    x, y = np.meshgrid(np.arange(grid.columns), np.arange(grid.rows))
    heights = []
    for across in (0.01, 0.5, 0.99):
        for along in (0.01, 0.5, 0.99):
            in_x_m = grid.min_x_m + (x + across) * grid.resolution_m
            in_y_m = grid.min_y_m + (y + along) * grid.resolution_m
            origins = np.stack([in_x_m, in_y_m, np.zeros(x.shape)], axis=-1).reshape(-1, 3)
            origins = origins @ view.world_from_view[:3, :3].T + view.world_from_view[:3, 3]
            origins[:, 2] = 10.0
            down = np.broadcast_to([0.0, 0.0, -1.0], origins.shape)
            heights.append(10.0 - true_ranges(seed, origins, down).reshape(x.shape))
    above_m = view.world_from_view[2, 3]
    return np.min(heights, axis=0) - above_m, np.max(heights, axis=0) - above_m


def range_accuracy(snapshot: HistorySnapshot, seed: int) -> MapAccuracy:
    """The preset's range map, its error of coding 5 mm, without the limits of the workspace."""
    request = ViewRequest(preset="range_map_workspace", max_x_m=6.0, max_range_m=10.0, max_error_m=0.005)
    view = shown_by(request, snapshot)
    wish = view_wish(request)
    size = wish.projection
    low, high = _depth_bounds(view, size, seed)
    assert view.values is not None
    with np.errstate(invalid="ignore"):
        shown = size.rays() * high[..., None]
        inside = ((shown > wish.low_m) & (shown < wish.high_m)).all(axis=2)
    judged = np.isfinite(view.values) & inside
    values = view.values[judged].astype(np.float64)
    return _judged("range_map_workspace", seed, values, low[judged], high[judged], inside[judged])


def _depth_bounds(view: DecodedView, size: Projection, seed: int) -> tuple[FloatArray, FloatArray]:
    """The nearest and farthest truth within each pixel, (rows, columns), by nine rays."""
    fine = Projection(
        size.spherical, 3 * size.columns, 3 * size.rows, size.horizontal_fov_rad, size.vertical_fov_rad
    )
    rays = fine.rays().reshape(-1, 3)
    length = np.linalg.norm(rays, axis=1)
    directions = (rays / length[:, None]) @ view.world_from_view[:3, :3].T
    origins = np.broadcast_to(view.world_from_view[:3, 3], directions.shape)
    depth = (true_ranges(seed, origins, directions) / length).reshape(size.rows, 3, size.columns, 3)
    return depth.min(axis=(1, 3)), depth.max(axis=(1, 3))


def _judged(
    name: str, seed: int, values: FloatArray, low: FloatArray, high: FloatArray, met: NDArray[np.bool_]
) -> MapAccuracy:
    shown = np.isfinite(values)
    flat, edge = shown & (high - low < FLAT_M), shown & (high - low >= FLAT_M)
    off = np.abs(values - (low + high) / 2)
    beyond = np.maximum(low - values, values - high)[edge]
    return MapAccuracy(
        name,
        seed,
        int(flat.sum()),
        _rms_mm(off[flat]),
        round(1e3 * float(np.quantile(off[flat], 0.95)), 1),
        int((off[flat] > 0.1).sum()),
        _rms_mm(off[flat & met]),
        int((flat & ~met).sum()),
        round(float(np.mean(beyond <= 0.03)), 4),
        round(float(shown.mean()), 4),
    )


def _rms_mm(off_m: FloatArray) -> float:
    return round(1e3 * float(np.sqrt(np.mean(off_m**2))), 1)


def cloud_accuracy(snapshot: HistorySnapshot, seed: int) -> SolidAccuracy:
    """The preset's cloud, decoded, every point against all returns of its window."""
    request = ViewRequest(preset="cloud_scene")
    view = shown_by(request, snapshot)
    source = look(view_wish(request), snapshot).points.points_m
    by_x = np.ascontiguousarray(source[np.argsort(source[:, 0])].astype(np.float64))
    far_m = _farthest(np.ascontiguousarray(view.points_m, dtype=np.float64), by_x, 2 * view.max_error_m)
    stated_mm, far_mm = (round(1e3 * each, 3) for each in (view.max_error_m, far_m))
    return SolidAccuracy("cloud_scene", seed, len(view.points_m), len(source), stated_mm, far_mm, 0)


@compiled
def _farthest(points: FloatArray, by_x: FloatArray, reach: float) -> float:
    """The largest distance from a point to its nearest of by_x (ascending in x); inf beyond reach."""
    worst = 0.0
    for i in range(len(points)):
        nearest2 = np.inf
        j = np.searchsorted(by_x[:, 0], points[i, 0] - reach)
        while j < len(by_x) and by_x[j, 0] <= points[i, 0] + reach:
            off = by_x[j] - points[i]
            nearest2 = min(nearest2, off[0] ** 2 + off[1] ** 2 + off[2] ** 2)
            j += 1
        worst = max(worst, nearest2)
    return float(np.sqrt(worst))


def octree_accuracy(snapshot: HistorySnapshot, seed: int) -> SolidAccuracy:
    """The preset's octree, decoded: is every return of its window in a leaf?"""
    request = ViewRequest(preset="octree_scene")
    view = shown_by(request, snapshot)
    wish = view_wish(request)
    leaf_m = wish.finest.resolution
    source = look(wish, snapshot).points.points_m.astype(np.float64)
    leaves = {tuple(each) for each in np.round(view.points_m / leaf_m - 0.5).astype(int).tolist()}
    cells, counts = np.unique(np.floor(source / leaf_m).astype(int), axis=0, return_counts=True)
    missing = sum(
        n for cell, n in zip(cells.tolist(), counts.tolist(), strict=True) if tuple(cell) not in leaves
    )
    stated_mm = round(1e3 * view.max_error_m, 3)
    return SolidAccuracy("octree_scene", seed, len(leaves), len(source), stated_mm, 0.0, int(missing))


def table(found: list[Accuracy]) -> str:
    """As Markdown, a table for each view."""
    lines: list[str] = []
    for name in dict.fromkeys(each.view for each in found):
        rows = [each for each in found if each.view == name]
        names = [each.name for each in fields(rows[0])][1:]
        lines += [f"{name}: {sum(row.holds for row in rows)} of {len(rows)} hold", ""]
        lines += ["| " + " | ".join(names) + " |", "|---" * len(names) + "|"]
        lines += ["| " + " | ".join(str(getattr(row, each)) for each in names) + " |" for row in rows] + [""]
    return "\n".join(lines)


def main() -> int:
    """Judge and print; 1 if a view is not as true as it must be."""
    parser = argparse.ArgumentParser(description="Views of the synthetic mission against its truth.")
    parser.add_argument("--seeds", type=int, default=16)
    parser.add_argument("--first", type=int, default=1, help="the first seed")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    found = [each for seed in seeds for each in accuracy(seed)]
    document = keep(
        "perception_accuracy", {"views": [{**asdict(each), "holds": each.holds} for each in found]}
    )
    print(json.dumps(document, indent=1) if arguments.json else table(found))
    return 0 if all(each.holds for each in found) else 1


if __name__ == "__main__":
    sys.exit(main())

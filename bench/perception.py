"""Views of two minutes of lidar: `python -m bench.perception [--json] [--runs 15] [--accuracy]`.

The synthetic mission's scanner walks through its scene for 120 s: 4,800 scans of 1,081 beams. Where a beam
met nothing, a wall 8 to 12 m away is put, so that all 5.2 million beams are points. Measured in this process
on one core: insertion (placing a scan, with the pose at each beam's time), rendering with encoding, memory,
and how 1,000 random requests keep to their budgets. --accuracy judges whole views of sixteen seeds against
the exact truth instead; it takes minutes.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.machine import keep
from messages.proto.straitlink.view_pb2 import (
    VIEW_STATUS_DOES_NOT_FIT,
    VIEW_STATUS_NO_DATA,
    VIEW_STATUS_RENDERED,
    View,
    ViewRequest,
)
from perception_server.answer import answer, look
from perception_server.decode import DecodedView, decode_view, grid_of
from perception_server.frames import FloatArray, StampedTransform, compose, inverse_poses
from perception_server.height_map import Grid
from perception_server.history import History, HistorySnapshot
from perception_server.scan_geometry import RawScan, ScanPlacement
from perception_server.view_presets import VIEW_PRESETS
from perception_server.view_wish import view_wish
from straitlink.synthetic.frames import map_from_head, map_from_lidar
from straitlink.synthetic.lidar import BEAMS, FIELD_OF_VIEW_RAD, SCAN_PERIOD_S, BoxField, Rays, Scanner
from straitlink.synthetic.rigid import quaternion_from_rotation
from straitlink.synthetic.scene import build_scene
from straitlink.synthetic.settings import START_NS

DURATION_S = 120.0
SEEDS = tuple(range(1, 17))
_SWEEP_S = 6.2
_MET_M = 0.05  # a return within this of a cell's true surface is one of it
_PLENTY = 1 << 20
_POSE_HZ = 1000 / 3
_BEAM_NS = SCAN_PERIOD_S / 1440 * 1e9
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True, slots=True)
class Timing:
    """Milliseconds of the thread's CPU; n: runs that these are of."""

    least_ms: float
    median_ms: float
    p95_ms: float
    worst_ms: float
    n: int


@dataclass(frozen=True, slots=True)
class Figures:
    """points: in the history. budget: outcomes of random requests, and how many broke their budget."""

    scans: int
    points: int
    insertion: Timing
    snapshot: Timing
    views: dict[str, Timing]
    view_bytes: dict[str, int]
    history_mb: float
    peak_mb: float
    budget: dict[str, int]


@dataclass(frozen=True, slots=True)
class Accuracy:
    """One view of one seed against the truth, on cells whose truth varies by less than 3 cm.

    rmse_met_mm: of those whose true surface one of their own returns met; unmet: how many others there are,
    which show what was seen beneath it. edges_within: share of the other cells between their true bounds
    +-3 cm. shown: share of the cells with returns that are no holes.
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


def synthetic_scans(seed: int, start_s: float, duration_s: float, fill: bool) -> list[RawScan]:
    """Scans of the synthetic mission; fill: a return for every beam."""
    scanner = Scanner(build_scene(seed), seed)
    random = np.random.default_rng(seed)
    scans = []
    for index in range(round(duration_s / SCAN_PERIOD_S)):
        at_s = start_s + index * SCAN_PERIOD_S
        ranges = scanner.scan(at_s).ranges_m.astype(np.float32)
        if fill:
            nothing = ~np.isfinite(ranges)
            ranges[nothing] = random.uniform(8.0, 12.0, int(nothing.sum()))
        scans.append(
            RawScan(
                "lidar",
                "lidar",
                START_NS + round(at_s * 1e9),
                _BEAM_NS,
                -FIELD_OF_VIEW_RAD / 2,
                FIELD_OF_VIEW_RAD / (BEAMS - 1),
                ranges,
                0.1,
                30.0,
            )
        )
    return scans


def poses(seed: int, start_s: float, duration_s: float) -> list[list[StampedTransform]]:
    """map <- head <- lidar at 333 Hz, a list per instant."""
    times_s = start_s - 0.01 + np.arange(round((duration_s + 0.05) * _POSE_HZ)) / _POSE_HZ
    head = _rows(map_from_head(times_s, seed))
    lidar = compose(inverse_poses(head), _rows(map_from_lidar(times_s, seed)))
    return [
        [
            StampedTransform(START_NS + round(t * 1e9), "map", "head", tuple(h)),
            StampedTransform(START_NS + round(t * 1e9), "head", "lidar", tuple(i)),
        ]
        for t, h, i in zip(times_s.tolist(), head.tolist(), lidar.tolist(), strict=True)
    ]


def fill_history(
    scans: list[RawScan], transforms: list[list[StampedTransform]]
) -> tuple[History, list[float]]:
    """The history, and what each insertion took in ms: the scan's own, its poses being there."""
    history = History(placement=ScanPlacement(sweep_frame="head"))
    took_ms, index = [], 0
    for scan in scans:
        while index < len(transforms) and transforms[index][0].stamp_ns < scan.end_ns + 5_000_000:
            history.insert_transforms(transforms[index], 0)
            index += 1
        started = time.thread_time()
        history.insert_scan(scan, 0)
        took_ms.append((time.thread_time() - started) * 1e3)
    return history, took_ms


def measure(runs: int, pairs: int) -> Figures:
    """All figures but accuracy."""
    scans, transforms = synthetic_scans(1, 0.0, DURATION_S, fill=True), poses(1, 0.0, DURATION_S)
    before_mb = _resident_mb()
    history, insertion_ms = fill_history(scans, transforms)
    history_mb = _resident_mb() - before_mb
    snapshot = history.snapshot()
    whole = ViewRequest(time_mode=ViewRequest.TIME_MODE_RELATIVE, window_s=2 * DURATION_S)
    views, sizes = {}, {}
    for preset in (
        "height_map_scene",
        "range_map_workspace",
        "range_map_scene",
        "octree_scene",
        "cloud_scene",
    ):
        request = ViewRequest(preset=preset)
        request.MergeFrom(whole)
        sizes[preset] = answer(request, snapshot, _PLENTY).ByteSize()  # and compiles
        views[preset] = _timed(lambda r=request: answer(r, snapshot, _PLENTY), runs)  # type: ignore[misc]
    return Figures(
        len(scans),
        sum(view.points for view in snapshot.scans),
        _timing(insertion_ms),
        _timed(history.snapshot, 200),
        views,
        sizes,
        round(history_mb, 1),
        round(_peak_mb(), 1),
        budget_outcomes(snapshot, pairs),
    )


def budget_outcomes(snapshot: HistorySnapshot, pairs: int) -> dict[str, int]:
    """How random requests ended; "broken" must stay 0."""
    random = np.random.default_rng(7)
    names = [name for name in VIEW_PRESETS if not name.endswith(("_hand", "_stereo"))]
    outcomes: Counter[str] = Counter(broken=0)
    for _ in range(pairs):
        request = ViewRequest(preset=str(random.choice(names)), codec=int(random.integers(0, 4)))  # type: ignore[arg-type]
        request.max_error_m = float(random.uniform(0.002, 0.02))
        request.worst_error_m = request.max_error_m * float(random.uniform(1, 20))
        request.denoise, request.close_gaps = (bool(random.random() < 0.2) for _ in range(2))
        budget_bytes = int(10 ** random.uniform(1.5, 4.5))
        outcomes[_outcome(answer(request, snapshot, budget_bytes), budget_bytes)] += 1
    return dict(outcomes)


def _outcome(view: View, budget_bytes: int) -> str:
    if view.status == VIEW_STATUS_RENDERED:
        decode_view(view.SerializeToString())
        return "fits" if view.ByteSize() <= budget_bytes else "broken"
    if view.status == VIEW_STATUS_DOES_NOT_FIT and view.smallest_bytes > budget_bytes:
        return "does not fit, said so"
    return "no data, said so" if view.status == VIEW_STATUS_NO_DATA else f"broken: {view.error}"


def accuracy(seed: int) -> list[Accuracy]:
    """The height map and the range map of one sweep against the scene."""
    start_s = 24.0
    history, _ = fill_history(
        synthetic_scans(seed, start_s, _SWEEP_S, fill=False), poses(seed, start_s, _SWEEP_S)
    )
    snapshot = history.snapshot()
    return [_height_accuracy(snapshot, seed), _range_accuracy(snapshot, seed)]


def _height_accuracy(snapshot: HistorySnapshot, seed: int) -> Accuracy:
    request = ViewRequest(preset="height_map_scene")
    view = decode_view(answer(request, snapshot, _PLENTY).SerializeToString())
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
    on_it = (z > low[row, column] - _MET_M) & (z < high[row, column] + _MET_M)
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
            heights.append(10.0 - _truth(seed, origins, down).reshape(x.shape) - view.world_from_view[2, 3])
    return np.min(heights, axis=0), np.max(heights, axis=0)


def _range_accuracy(snapshot: HistorySnapshot, seed: int) -> Accuracy:
    request = ViewRequest(preset="range_map_workspace", max_x_m=6.0, max_range_m=10.0, max_error_m=0.005)
    view = decode_view(answer(request, snapshot, _PLENTY).SerializeToString())
    wish = view_wish(request)
    size = wish.projection
    fine = type(size)(
        size.spherical, 3 * size.columns, 3 * size.rows, size.horizontal_fov_rad, size.vertical_fov_rad
    )
    rays = fine.rays().reshape(-1, 3)
    length = np.linalg.norm(rays, axis=1)
    directions = (rays / length[:, None]) @ view.world_from_view[:3, :3].T
    origins = np.broadcast_to(view.world_from_view[:3, 3], directions.shape)
    depth = (_truth(seed, origins, directions) / length).reshape(size.rows, 3, size.columns, 3)
    low, high = depth.min(axis=(1, 3)), depth.max(axis=(1, 3))
    assert view.values is not None
    with np.errstate(invalid="ignore"):
        shown = size.rays() * high[..., None]
        inside = ((shown > wish.low_m) & (shown < wish.high_m)).all(axis=2)
    judged = np.isfinite(view.values) & inside
    return _judged(
        "range_map_workspace", seed, view.values[judged], low[judged], high[judged], inside[judged]
    )


def _judged(
    name: str, seed: int, values: FloatArray, low: FloatArray, high: FloatArray, met: NDArray[np.bool_]
) -> Accuracy:
    shown = np.isfinite(values)
    flat, edge = shown & (high - low < 0.03), shown & (high - low >= 0.03)
    off = np.abs(values - (low + high) / 2)
    beyond = np.maximum(low - values, values - high)[edge]
    return Accuracy(
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


def _truth(seed: int, origins_m: FloatArray, directions: FloatArray) -> FloatArray:
    field = BoxField(build_scene(seed))
    starts = range(0, len(origins_m), 20_000)
    parts = [field.cast(Rays(origins_m[i : i + 20_000], directions[i : i + 20_000]))[0] for i in starts]
    return np.concatenate(parts)


def _rows(matrices: FloatArray) -> FloatArray:
    return np.concatenate([matrices[:, :3, 3], quaternion_from_rotation(matrices[:, :3, :3])], axis=1)


def _timed(call: Callable[[], object], runs: int) -> Timing:
    took_ms = []
    for _ in range(runs):
        started = time.thread_time()  # of this core alone, whatever else the machine does
        call()
        took_ms.append((time.thread_time() - started) * 1e3)
    return _timing(took_ms)


def _timing(took_ms: list[float]) -> Timing:
    return Timing(
        round(min(took_ms), 3),
        round(statistics.median(took_ms), 3),
        round(float(np.quantile(took_ms, 0.95)), 3),
        round(max(took_ms), 3),
        len(took_ms),
    )


def _resident_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * _PAGE_BYTES / 1e6


def _peak_mb() -> float:
    status = Path("/proc/self/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) * 1024 / 1e6


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=15, help="of each view")
    parser.add_argument("--pairs", type=int, default=1000, help="random requests and budgets")
    parser.add_argument("--accuracy", action="store_true", help="against the truth, instead of speed")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    found: object
    if arguments.accuracy:
        found = [asdict(each) for seed in SEEDS for each in accuracy(seed)]
    else:
        found = asdict(measure(arguments.runs, arguments.pairs))
        keep("perception", found)
    if arguments.json:
        json.dump(found, sys.stdout, indent=1)
        return
    for line in found if isinstance(found, list) else found.items():
        print(*(line.values() if isinstance(line, dict) else line))


if __name__ == "__main__":
    main()

"""Views of two minutes of lidar: `python -m bench.perception [--json] [--runs 15]`.

The synthetic mission's scanner walks through its scene for 120 s: 4,800 scans of 1,081 beams. Where a beam
met nothing, a wall 8 to 12 m away is put, so that all 5.2 million beams are points. Measured in this process
on one core: insertion (placing a scan, with the pose at each beam's time), rendering with encoding, memory,
and how 1,000 random requests keep to their budgets. --accuracy is `python -m bench.perception_accuracy`.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from bench.machine import keep
from messages.proto.straitlink.view_pb2 import (
    VIEW_STATUS_DOES_NOT_FIT,
    VIEW_STATUS_NO_DATA,
    VIEW_STATUS_RENDERED,
    View,
    ViewRequest,
)
from perception_server.answer import answer
from perception_server.decode import decode_view
from perception_server.frames import FloatArray, StampedTransform, compose, inverse_poses
from perception_server.history import History, HistorySnapshot
from perception_server.scan_geometry import RawScan, ScanPlacement
from perception_server.view_presets import VIEW_PRESETS
from straitlink.synthetic.frames import map_from_head, map_from_lidar
from straitlink.synthetic.lidar import BEAMS, FIELD_OF_VIEW_RAD, SCAN_PERIOD_S, Scanner
from straitlink.synthetic.rigid import quaternion_from_rotation
from straitlink.synthetic.scene import build_scene
from straitlink.synthetic.settings import START_NS

DURATION_S = 120.0
PLENTY = 1 << 20  # bytes: no budget
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
        sizes[preset] = answer(request, snapshot, PLENTY).ByteSize()  # and compiles
        views[preset] = _timed(lambda r=request: answer(r, snapshot, PLENTY), runs)  # type: ignore[misc]
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
    parser.add_argument("--accuracy", action="store_true", help="run bench.perception_accuracy instead")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    if arguments.accuracy:
        sys.exit(subprocess.call([sys.executable, "-m", "bench.perception_accuracy"]))
    found = asdict(measure(arguments.runs, arguments.pairs))
    keep("perception", found)
    if arguments.json:
        json.dump(found, sys.stdout, indent=1)
        return
    for line in found.items():
        print(*line)


if __name__ == "__main__":
    main()

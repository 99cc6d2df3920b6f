"""The overview (10 mm, denoised, gaps closed) of the synthetic mission's floor, against the true surface."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.perception import fill_history, poses, synthetic_scans
from bench.perception_accuracy import height_bounds
from bench.view_rows import Coded, Row, coded, row
from messages.proto.straitlink.view_pb2 import ViewRequest
from perception_server.answer import look
from perception_server.decode import decode_view_message
from perception_server.frames import FloatArray
from perception_server.height_map import render_height_map
from perception_server.history import HistorySnapshot
from perception_server.view_codec import decode_map, encode_map
from perception_server.view_encoding import Drawing, encode_view
from perception_server.view_wish import view_wish

SEEDS = (1, 2, 3, 4, 5)
START_S, SWEEP_S = 24.0, 6.2
EDGE_M = 0.03  # a cell whose truth varies by more is at an edge
WISHES: dict[str, dict[str, Any]] = {
    "zlib, 5 mm": {"max_error_m": 0.005, "codec": "zlib"},
    "context, 5 mm": {"max_error_m": 0.005},
    "overview": {"max_error_m": 0.01, "denoise": True, "close_gaps": True},
}


def overview_rows() -> Iterator[Row]:
    """The mission's height maps of several scenes; p95_mm over all cells away from edges, closed ones too."""
    scenes = [_height_map_and_truth(seed) for seed in SEEDS]
    paper: list[Coded] = []
    for codec, wish in WISHES.items():
        encode = partial(encode_map, **wish)
        done = [coded(values, encode, decode_map) for values, _, _ in scenes]
        off_m = [_errors_m(decode_map(encode_map(v, **wish)).values, low, high) for v, low, high in scenes]
        paper = paper or done
        p95_mm = round(max(1e3 * float(np.quantile(each, 0.95)) for each in off_m), 2)
        yield replace(row("mission height map", codec, done, paper), p95_mm=p95_mm)


def _errors_m(values: NDArray[np.float32], low: FloatArray, high: FloatArray) -> FloatArray:
    judged = np.isfinite(values) & (high - low < EDGE_M)
    errors: FloatArray = np.abs(values - (low + high) / 2)[judged]
    return errors


def _height_map_and_truth(seed: int) -> tuple[NDArray[np.float32], FloatArray, FloatArray]:
    """A sweep's height map, and the lowest and highest true point of each cell; above the region NaN."""
    scans = synthetic_scans(seed, START_S, SWEEP_S, fill=False)
    snapshot: HistorySnapshot = fill_history(scans, poses(seed, START_S, SWEEP_S))[0].snapshot()
    wish = view_wish(ViewRequest(preset="height_map_scene"))
    scene = look(wish, snapshot)
    view = decode_view_message(encode_view(scene.header, wish, Drawing(wish, scene.points), wish.finest))
    low, high = height_bounds(view, seed)
    shown = np.where(high < wish.high_m[2], high, np.nan)  # what hangs above is cut off by the request
    grid = wish.grid(wish.finest.resolution)
    points = scene.points
    return render_height_map(points.points_m, grid, points.origins_m, points.stops), low, shown

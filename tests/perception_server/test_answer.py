"""Requests and their replies: bounds, budgets, windows, viewpoints, decoding alone."""

from __future__ import annotations

import contextlib
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from messages.proto.straitlink.view_pb2 import (
    VIEW_STATUS_DOES_NOT_FIT,
    VIEW_STATUS_NO_DATA,
    VIEW_STATUS_REFUSED,
    VIEW_STATUS_RENDERED,
    View,
    ViewRequest,
)
from perception_server.answer import answer
from perception_server.decode import decode_view, parse_view, to_grid, to_point_cloud
from perception_server.frames import StampedTransform
from perception_server.history import History
from perception_server.pictures import Disparity
from perception_server.scan_geometry import RawCloud, RawScan
from perception_server.view_codec import DecodeError
from perception_server.view_presets import VIEW_PRESETS
from tests.perception_server.preset_table import preset_rows
from tests.perception_server.synthetic_history import one_sweep

S = 1_000_000_000
PLENTY = 1 << 20
HEIGHT = ViewRequest.FORMAT_HEIGHT_MAP
FAST = ViewRequest.CODEC_SERPENTINE


def still_robot() -> History:
    """Known poses for 100 s: base at (1, 2, 3), turned to the left by a right angle."""
    history = History()
    half = math.sqrt(0.5)
    for t in range(101):
        history.insert_transforms(
            [StampedTransform(t * S, "map", "base", (1.0, 2.0, 3.0, 0.0, 0.0, half, half))], 0
        )
    return history


def cloud(history: History, points: list[list[float]], at_s: float = 50.0) -> None:
    data = np.array(points, dtype=np.float32)
    history.insert_cloud(RawCloud("depth", "base", round(at_s * S), data), 0)


@pytest.mark.parametrize(
    ("fields", "error"),
    [
        ({"preset": "hm"}, "preset = 'hm': must be one of height_map_scene"),
        ({}, "format: must be said"),
        ({"preset": "height_map_scene", "max_error_m": 5.0}, "max_error_m = 5: must be within 0.0005..1"),
        ({"preset": "height_map_scene", "resolution_m": math.nan}, "resolution_m = nan: must be within"),
        ({"preset": "height_map_scene", "max_x_m": -2.0}, "max_x_m = -2: must be above min_x_m = -1"),
        ({"preset": "height_map_scene", "resolution_m": 0.001}, "resolution_m = 0.001: 6000 x 4000 cells"),
        (
            {"preset": "height_map_scene", "projection": 2},
            "projection = PROJECTION_PERSPECTIVE: only a range",
        ),
        ({"preset": "height_map_scene", "format": 77}, "format = 77: must be one of"),
        ({"preset": "height_map_scene", "time_mode": 3}, "start_ns: must be said"),
        ({"preset": "height_map_scene", "worst_error_m": 0.001}, "worst_error_m = 0.001: must be at least"),
        (
            {"preset": "range_map_workspace", "horizontal_fov_rad": 3.2},
            "horizontal_fov_rad = 3.2: must be at",
        ),
        ({"preset": "range_map_workspace", "width_px": 1024, "height_px": 1024}, "width_px = 1024: 1024 x"),
        ({"preset": "range_map_workspace", "max_range_m": 0.05}, "max_range_m = 0.05: must be above"),
    ],
)
def test_a_bad_request_is_refused_by_the_name_of_its_field(fields: dict[str, object], error: str) -> None:
    view = answer(ViewRequest(request_id=9, **fields), one_sweep(), PLENTY)  # type: ignore[arg-type]
    assert (view.status, view.request_id, view.data) == (VIEW_STATUS_REFUSED, 9, b"")
    assert view.error.startswith(error)


def test_thirteen_half_planes_are_one_too_many() -> None:
    plane = ViewRequest.HalfPlane(normal_x=1.0)
    request = ViewRequest(preset="cloud_scene", half_planes=[plane] * 13)
    assert answer(request, one_sweep(), PLENTY).error == "half_planes: 13 of them: must be at most 12"


@pytest.mark.parametrize("preset", sorted(VIEW_PRESETS))
def test_every_preset_is_within_its_own_bounds(preset: str) -> None:
    view = answer(ViewRequest(preset=preset, codec=FAST), one_sweep(), PLENTY)
    without_source = preset.endswith(("_hand", "_stereo"))
    assert view.status == (VIEW_STATUS_NO_DATA if without_source else VIEW_STATUS_RENDERED), view.error


@settings(max_examples=25, deadline=None)
@given(
    preset=st.sampled_from(
        ["height_map_scene", "height_map_corridor", "range_map_workspace", "cloud_workspace", "octree_scene"]
    ),
    budget=st.integers(0, 6000),
    worst=st.floats(1, 30),
)
def test_a_reply_is_within_its_budget_or_says_what_it_takes(preset: str, budget: int, worst: float) -> None:
    error_m = VIEW_PRESETS[preset].max_error_m
    request = ViewRequest(preset=preset, codec=FAST, worst_error_m=min(1.0, error_m * worst))
    view = answer(request, one_sweep(), budget)
    if view.status == VIEW_STATUS_RENDERED:
        assert view.ByteSize() <= budget
        decoded = decode_view(view.SerializeToString())
        if "octree" not in preset:
            assert decoded.max_error_m <= request.worst_error_m * 1.0001
    else:
        assert view.status == VIEW_STATUS_DOES_NOT_FIT
        assert view.error == f"does not fit: smallest is {view.smallest_bytes} bytes"
        assert answer(request, one_sweep(), view.smallest_bytes).status == VIEW_STATUS_RENDERED


def test_the_budget_costs_error_first_and_the_reply_says_so() -> None:
    request = ViewRequest(preset="height_map_scene", codec=FAST)
    whole = answer(request, one_sweep(), PLENTY)
    tight = answer(request, one_sweep(), whole.ByteSize() * 9 // 10)
    assert (whole.coarsened, tight.coarsened) == (False, True)
    assert tight.resolution_m == whole.resolution_m
    assert 0.0051 < tight.max_error_m <= 0.02


def test_a_view_that_was_altered_says_so() -> None:
    request = ViewRequest(preset="height_map_corridor", denoise=True, close_gaps=True)
    view = answer(request, one_sweep(), PLENTY)
    assert view.denoised and view.gaps_closed
    assert decode_view(view.SerializeToString()).closed.any()  # type: ignore[union-attr]


def test_points_return_to_where_they_were_in_the_world() -> None:
    history = still_robot()
    cloud(history, [[0.5, 0.25, 0.125]])
    request = ViewRequest(
        format=ViewRequest.FORMAT_CLOUD,
        source=ViewRequest.SOURCE_CLOUD,
        frame_id="base",
        pitch_rad=0.3,
        roll_rad=-0.2,
        yaw_rad=1.0,
        x_m=0.7,
        max_error_m=0.001,
    )
    decoded = decode_view(answer(request, history.snapshot(), PLENTY).SerializeToString())
    np.testing.assert_allclose(decoded.world_points_m, [[0.75, 2.5, 3.125]], atol=0.0011)


def test_a_half_plane_keeps_its_positive_side() -> None:
    history = still_robot()
    cloud(history, [[1, 0, 0], [2, 0, 0], [3, 0, 0]])
    request = ViewRequest(
        format=ViewRequest.FORMAT_CLOUD, source=ViewRequest.SOURCE_CLOUD, frame_id="base", max_error_m=0.001
    )
    request.half_planes.add(normal_x=-1.0, offset_m=2.5)
    request.half_planes.add(normal_x=1.0, offset_m=-1.5)
    decoded = decode_view(answer(request, history.snapshot(), PLENTY).SerializeToString())
    np.testing.assert_allclose(decoded.points_m, [[2, 0, 0]], atol=0.001)


@pytest.mark.parametrize(
    ("fields", "seen"),
    [
        ({"time_mode": ViewRequest.TIME_MODE_LATEST_SWEEP}, [90]),
        ({"time_mode": ViewRequest.TIME_MODE_RELATIVE, "window_s": 25.0}, [70, 80, 90]),
        ({"time_mode": ViewRequest.TIME_MODE_RELATIVE, "window_s": 5.0, "age_s": 8.0}, [80]),
        ({"time_mode": ViewRequest.TIME_MODE_ABSOLUTE, "start_ns": 45 * S, "end_ns": 60 * S}, [50, 60]),
    ],
)
def test_a_window_takes_its_time_and_no_other(fields: dict[str, int], seen: list[int]) -> None:
    history = still_robot()
    for at_s in range(50, 100, 10):
        cloud(history, [[at_s / 100, 0, 0]], at_s)
    request = ViewRequest(
        format=ViewRequest.FORMAT_CLOUD,
        source=ViewRequest.SOURCE_CLOUD,
        frame_id="base",
        max_error_m=0.001,
        resolution_m=0.001,
        **fields,  # type: ignore[arg-type]
    )
    view = answer(request, history.snapshot(), PLENTY)
    decoded = decode_view(view.SerializeToString())
    np.testing.assert_allclose(sorted(decoded.points_m[:, 0] * 100), seen, atol=0.11)
    assert view.newest_ns == seen[-1] * S and view.span_us == (seen[-1] - seen[0]) * 1_000_000


def test_an_empty_history_and_an_unknown_frame_say_so() -> None:
    assert (
        answer(ViewRequest(preset="cloud_scene"), History().snapshot(), PLENTY).status == VIEW_STATUS_NO_DATA
    )
    view = answer(ViewRequest(preset="cloud_scene", frame_id="tail"), one_sweep(), PLENTY)
    assert (view.status, view.error) == (VIEW_STATUS_NO_DATA, "no transform connects 'tail' with 'map'")


def sweep_of_a_spindle(speed_mps: float) -> View:
    """The latest sweep of a scanner that turns at 18 degrees/s, 1.8 between scans, and moves along x."""
    history = still_robot()
    for step in range(400):
        stamp_ns = round((10 + step * 0.1) * S)
        turn = math.radians(1.8 * step) / 2
        for at_ns in (stamp_ns, stamp_ns + 1000):
            pose = (speed_mps * step * 0.1, 0.0, 0.0, math.sin(turn), 0.0, 0.0, math.cos(turn))
            history.insert_transforms([StampedTransform(at_ns, "base", "laser", pose)], 0)
        ranges = np.ones(10, np.float32)
        history.insert_scan(RawScan("scan", "laser", stamp_ns, 0.0, 0.0, 0.1, ranges), 0)
    request = ViewRequest(preset="cloud_scene", frame_id="base", time_mode=ViewRequest.TIME_MODE_LATEST_SWEEP)
    return answer(request, history.snapshot(), PLENTY)


def test_the_sweep_of_a_spindle_is_its_last_half_turn() -> None:
    assert sweep_of_a_spindle(0.0).source_count in (102, 103)  # 183 degrees / 1.8, and the first


def test_the_sweep_of_a_scanner_that_moves_goes_on_until_its_ends_overlap() -> None:
    # 1.23 m on the way, seen from 1.5 m: 39 degrees more.
    assert sweep_of_a_spindle(0.1).source_count in (124, 125)
    assert sweep_of_a_spindle(2.0).source_count in (127, 128)  # never more than 45 degrees


def test_a_disparity_image_becomes_points_before_its_camera() -> None:
    history = still_robot()
    pose = (0.0, 0.0, 0.0, -0.5, 0.5, -0.5, 0.5)  # optical: z forward, x right, y down
    history.insert_transforms([StampedTransform(0, "base", "optical", pose, is_static=True)], 0)
    disparity = np.full((4, 4), np.nan, np.float32)
    disparity[1, 3] = 10.0
    history.insert_disparity(Disparity("head", "optical", 50 * S, disparity, 100.0, 0.1, 1.0, 1.0))
    request = ViewRequest(
        preset="range_map_stereo", frame_id="base", format=ViewRequest.FORMAT_CLOUD, max_error_m=0.001
    )
    decoded = decode_view(answer(request, history.snapshot(), PLENTY).SerializeToString())
    np.testing.assert_allclose(decoded.points_m, [[1.0, -0.02, 0.0]], atol=0.0011)


def test_a_height_map_is_a_foxglove_grid_where_its_points_are() -> None:
    view = answer(ViewRequest(preset="height_map_corridor", codec=FAST), one_sweep(), PLENTY)
    decoded = decode_view(view.SerializeToString())
    grid, points = to_grid(decoded), to_point_cloud(decoded)
    assert (grid.column_count, grid.row_stride, len(grid.data)) == (200, 800, 200 * 40 * 4)
    values = np.frombuffer(grid.data, np.float32).reshape(40, 200)
    row, column = np.argwhere(np.isfinite(values))[0]
    local = [
        (column + 0.5) * grid.cell_size.x - 0.0,
        (row + 0.5) * grid.cell_size.y - 1.0,
        values[row, column],
    ]
    np.testing.assert_allclose(np.frombuffer(points.data, np.float32)[:3], local, atol=1e-5)
    with pytest.raises(ValueError, match="only a height map"):
        to_grid(
            decode_view(answer(ViewRequest(preset="cloud_scene"), one_sweep(), PLENTY).SerializeToString())
        )


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_damaged_views_are_decode_errors_and_nothing_else(data: st.DataObject) -> None:
    preset = data.draw(
        st.sampled_from(["height_map_corridor", "range_map_scene", "cloud_scene", "octree_scene"])
    )
    request = ViewRequest(preset=preset, codec=FAST, resolution_m=0.1, width_px=40, height_px=40)
    whole = bytearray(answer(request, one_sweep(), PLENTY).SerializeToString())
    for _ in range(data.draw(st.integers(1, 4))):
        whole[data.draw(st.integers(0, len(whole) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    damaged = bytes(whole[: data.draw(st.integers(0, len(whole)))])
    with contextlib.suppress(DecodeError):
        decode_view(damaged)


@pytest.mark.parametrize(
    ("view", "why"),
    [
        (View(status=VIEW_STATUS_REFUSED, error="x"), "carries no picture: x"),
        (View(status=VIEW_STATUS_RENDERED, format=HEIGHT, resolution_m=math.nan), "resolution_m of a view"),
        (View(status=VIEW_STATUS_RENDERED), "format 0"),
        (View(status=VIEW_STATUS_RENDERED, format=HEIGHT), "empty|bytes|codec"),
    ],
)
def test_a_view_that_is_none_is_a_decode_error(view: View, why: str) -> None:
    with pytest.raises(DecodeError, match=why):
        decode_view(view.SerializeToString())
    with pytest.raises(DecodeError, match=r"are no straitlink\.View"):
        parse_view(b"\xff\xff\xff")


def test_the_documents_table_of_presets_is_the_code_s() -> None:
    text = (Path(__file__).parents[2] / "docs" / "perception.md").read_text()
    assert "\n".join(preset_rows()) in text

"""Views of the synthetic mission against its exact truth."""

from __future__ import annotations

import numpy as np

from messages.proto.straitlink.view_pb2 import VIEW_STATUS_RENDERED, ViewRequest
from perception_server.answer import answer, look
from perception_server.decode import DecodedView, decode_view, grid_of
from perception_server.frames import FloatArray
from perception_server.range_map import Projection
from perception_server.view_wish import view_wish
from tests.perception_server.synthetic_history import one_sweep, true_ranges

PLENTY = 1 << 20
FLAT_M = 0.03  # cells whose truth varies less are judged by their error, the others by their bounds


def rendered(request: ViewRequest, seed: int) -> DecodedView:
    view = answer(request, one_sweep(seed), PLENTY)
    assert view.status == VIEW_STATUS_RENDERED, view.error
    return decode_view(view.SerializeToString())


def true_heights(view: DecodedView, seed: int) -> tuple[FloatArray, FloatArray]:
    """Lowest and highest truth within each cell, (rows, columns), from 3 x 3 rays each."""
    grid = grid_of(view)
    x, y = np.meshgrid(np.arange(grid.columns), np.arange(grid.rows))
    top_m = 10.0
    heights = []
    for across in (0.01, 0.5, 0.99):
        for along in (0.01, 0.5, 0.99):
            cell = np.stack(
                [
                    grid.min_x_m + (x + across) * grid.resolution_m,
                    grid.min_y_m + (y + along) * grid.resolution_m,
                    np.zeros_like(x, dtype=float),
                ],
                axis=-1,
            ).reshape(-1, 3)
            origins = cell @ view.world_from_view[:3, :3].T + view.world_from_view[:3, 3]
            origins[:, 2] = top_m
            down = np.broadcast_to([0.0, 0.0, -1.0], origins.shape)
            height = top_m - true_ranges(seed, origins, down) - view.world_from_view[2, 3]
            heights.append(height.reshape(x.shape))
    return np.min(heights, axis=0), np.max(heights, axis=0)


def true_depths(view: DecodedView, projection: Projection, seed: int) -> tuple[FloatArray, FloatArray]:
    """Nearest and farthest truth within each pixel, from 3 x 3 rays each; inf where nothing is."""
    fine = Projection(
        projection.spherical,
        3 * projection.columns,
        3 * projection.rows,
        projection.horizontal_fov_rad,
        projection.vertical_fov_rad,
    )
    rays = fine.rays().reshape(-1, 3)
    length = np.linalg.norm(rays, axis=1)
    directions = (rays / length[:, None]) @ view.world_from_view[:3, :3].T
    origins = np.broadcast_to(view.world_from_view[:3, 3], directions.shape)
    depth = (true_ranges(seed, origins, directions) / length).reshape(
        projection.rows, 3, projection.columns, 3
    )
    return depth.min(axis=(1, 3)), depth.max(axis=(1, 3))


def judge(values: FloatArray, low: FloatArray, high: FloatArray, judged: FloatArray) -> None:
    values, low, high = values[judged], low[judged], high[judged]
    flat = high - low < FLAT_M
    errors = np.abs(values - (low + high) / 2)[flat]
    assert flat.sum() > 1500
    assert np.sqrt(np.mean(errors**2)) <= 0.012
    assert np.quantile(errors, 0.95) <= 0.020
    beyond = np.maximum(low - values, values - high)[~flat]
    assert np.mean(beyond <= 0.03) >= 0.98


def test_a_height_map_is_true_to_the_terrain() -> None:
    # A part of the scene and one seed: the truth of a cell costs more than its view. bench.perception
    # judges whole views of several seeds.
    seed = 1
    view = rendered(ViewRequest(preset="height_map_scene", min_x_m=1.0, max_x_m=3.0), seed)
    low, high = true_heights(view, seed)
    assert view.values is not None
    judge(view.values.astype(float), low, high, np.isfinite(view.values) & (high < 0.3))


def test_a_range_map_is_true_to_what_its_viewpoint_would_see() -> None:
    request = ViewRequest(preset="range_map_workspace", max_x_m=6.0, max_range_m=10.0, max_error_m=0.005)
    request.width_px, request.height_px = 90, 90  # the truth of a pixel costs more than its view
    view = rendered(request, 1)
    assert view.values is not None
    projection = view_wish(request).projection
    low, high = true_depths(view, projection, 1)
    surface = projection.rays() * high[..., None]
    wish = view_wish(request)
    inside = ((surface > wish.low_m) & (surface < wish.high_m)).all(axis=2) & np.isfinite(view.values)
    judge(view.values.astype(float), low, high, inside)


def test_a_back_projected_cloud_lies_within_its_stated_error_of_the_returns() -> None:
    request = ViewRequest(preset="cloud_scene", max_error_m=0.01, min_x_m=0.0, max_x_m=2.0)
    view = rendered(request, 1)
    scene = look(view_wish(request), one_sweep(1))
    source = scene.points.points_m.astype(np.float64)
    assert 500 < len(view.points_m) < len(source)
    assert 0 < view.max_error_m <= 0.01
    chosen = np.random.default_rng(1).choice(len(view.points_m), 150, replace=False)
    for point in view.points_m[chosen].astype(np.float64):
        assert np.sqrt(((source - point) ** 2).sum(axis=1).min()) <= view.max_error_m + 1e-6


def test_an_octree_contains_every_return() -> None:
    request = ViewRequest(preset="octree_scene", resolution_m=0.05)
    view = rendered(request, 1)
    source = look(view_wish(request), one_sweep(1)).points.points_m
    leaf_m = 0.05
    leaves = {tuple(k) for k in np.round(view.points_m / leaf_m - 0.5).astype(int).tolist()}
    assert len(source) > 10_000
    assert {
        tuple(k) for k in np.unique(np.floor(source / np.float64(leaf_m)), axis=0).astype(int).tolist()
    } <= leaves


def test_world_points_stand_where_the_scene_is() -> None:
    view = rendered(ViewRequest(preset="cloud_scene"), 1)
    world = view.world_points_m
    assert np.quantile(np.abs(world[:, 2]), 0.1) < 0.03  # the floor is at z = 0 in map
    assert world[:, 0].max() < 7.6 + 0.2  # the wall

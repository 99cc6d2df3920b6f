"""Height maps of made-up places: what is shown, and what stays a hole because no return can tell."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from perception_server.frames import FloatArray
from perception_server.height_map import Grid, render_height_map

GRID = Grid(0.0, -0.6, 0.03, 40, 40)
SENSOR = np.array([-1.0, 0.0, 1.5])


def seen(points: FloatArray, grid: Grid = GRID) -> NDArray[np.float32]:
    origins = SENSOR[None].astype(np.float32)
    return render_height_map(points.astype(np.float32), grid, origins, np.array([len(points)]))


def level(x: tuple[float, float], y: tuple[float, float], z: float) -> FloatArray:
    """Returns every centimetre of a horizontal surface."""
    across, along = np.meshgrid(np.arange(x[0], x[1], 0.01) + 0.003, np.arange(y[0], y[1], 0.01) + 0.003)
    return np.stack([across.ravel(), along.ravel(), np.full(across.size, z)], axis=-1)


def test_floor_that_was_seen_beneath_an_edge_is_a_hole() -> None:
    floor, edge = level((0.0, 1.2), (-0.6, 0.6), 0.0), level((0.6, 0.63), (-0.2, 0.2), 0.35)
    edge = np.concatenate([edge - [0.0, 0.0, drop] for drop in (0.0, 0.03, 0.06, 0.09)])
    heights = seen(np.concatenate([floor, edge]))
    beneath, beside, before = heights[16:24, 23:28], heights[:8, 23:28], heights[16:24, 5:17]
    assert np.isnan(beneath).all()
    assert np.abs(beside).max() < 0.01
    assert np.abs(before).max() < 0.01


def test_floor_that_was_seen_over_a_block_is_shown() -> None:
    floor = level((0.0, 0.6), (-0.6, 0.6), 0.0)
    block = level((0.6, 0.75), (-0.6, 0.6), 0.2)
    behind = level((1.05, 1.2), (-0.6, 0.6), 0.0)
    heights = seen(np.concatenate([floor, block, behind]))
    assert np.abs(heights[:, 36:]).max() < 0.01
    assert np.abs(heights[:, 21:24] - 0.2).max() < 0.01


def test_single_returns_of_a_face_do_not_stand_for_the_floor_beside_it() -> None:
    rim = level((0.6, 0.63), (-0.3, 0.3), 1.2)
    rim = np.concatenate([rim - [0.0, 0.0, drop] for drop in (0.0, 0.1, 0.2)])
    strays = np.array([[0.595, 0.01, 1.15], [0.595, 0.04, 1.15]])
    heights = seen(np.concatenate([rim, strays]))
    assert np.isnan(heights[20:22, 19]).all()


def test_a_wall_on_the_border_of_two_cells_stands_in_the_one_behind() -> None:
    random = np.random.default_rng(3)
    up, along = np.meshgrid(np.arange(0.0, 1.2, 0.02), np.arange(-0.6, 0.6, 0.005))
    # The noise is along the beams; the wall's mean lies 4 mm behind the border at 0.6.
    wall = np.stack([0.604 + random.normal(0.0, 0.01, up.size), along.ravel(), up.ravel()], axis=-1)
    floor = level((0.0, 0.6), (-0.6, 0.6), 0.0)
    heights = seen(np.concatenate([floor, wall]))
    assert np.nanmax(heights[1:-1, :20]) < 0.05
    assert np.nanmin(heights[1:-1, 20]) > 1.1


def test_a_view_without_points_is_all_holes() -> None:
    nothing = np.zeros((0, 3), np.float32)
    heights = render_height_map(nothing, GRID, np.zeros((0, 3), np.float32), np.zeros(0, np.int64))
    assert np.isnan(heights).all()

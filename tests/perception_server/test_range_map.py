"""Range maps: what their pixels see, and the half-planes by which the rest is passed over."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from perception_server.range_map import Projection, render_range_map

POINTS = np.random.default_rng(5).uniform(-4.0, 4.0, (4000, 3)).astype(np.float32)


@given(st.booleans(), st.floats(0.2, 3.0), st.floats(0.2, 3.0))
@settings(max_examples=30, deadline=None)
def test_points_outside_a_projections_half_planes_are_seen_by_no_pixel(
    spherical: bool, across_rad: float, up_rad: float
) -> None:
    projection = Projection(spherical, 24, 16, across_rad, up_rad)
    planes = projection.planes()
    inside = (POINTS @ planes[:, :3].T + planes[:, 3] >= 0).all(axis=1)
    assert 0 < inside.sum() < len(POINTS)
    np.testing.assert_array_equal(
        render_range_map(POINTS[inside], projection), render_range_map(POINTS, projection)
    )


def test_a_spherical_map_wider_than_half_a_turn_has_no_half_planes() -> None:
    assert len(Projection(True, 24, 16, 6.0, 1.0).planes()) == 0


def test_a_stray_return_of_an_edge_is_not_what_the_pixel_beside_it_shows() -> None:
    projection = Projection(False, 3, 1, 0.3, 0.1)

    def pixel(column: int, depth_m: float, count: int) -> list[tuple[float, float, float]]:
        across = np.tan(0.15) * (1 - 2 * (column + 0.5) / 3)
        return [(depth_m, depth_m * across, 0.0)] * count

    far = [*pixel(0, 4.0, 9), *pixel(1, 4.0, 9)]
    stray = np.array([*far, *pixel(1, 3.0, 1), *pixel(2, 3.0, 9)], np.float32)
    np.testing.assert_array_equal(render_range_map(stray, projection), [[4.0, np.nan, 3.0]])
    wire = np.array([*far, *pixel(1, 3.0, 1), *pixel(2, 4.0, 9)], np.float32)  # no neighbour has more of it
    np.testing.assert_array_equal(render_range_map(wire, projection), [[4.0, 3.0, 4.0]])

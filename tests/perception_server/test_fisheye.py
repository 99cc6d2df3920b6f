"""Lens models against OpenCV's, virtual views against what a straight camera sees."""

from __future__ import annotations

import math
from itertools import product

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from perception_server.camera_model import CameraModel, camera_model
from perception_server.errors import NoDataError, RequestError
from perception_server.fisheye import VirtualView, rectify
from straitlink.synthetic.camera import Pinhole, Renderer
from straitlink.synthetic.fisheye import FisheyeRenderer
from straitlink.synthetic.rigid import transform
from straitlink.synthetic.scene import build_scene

KANNALA = (0.05, -0.012, 0.004, -0.0007)
MATRIX = (260.0, 0, 315.0, 0, 255.0, 246.0, 0, 0, 1)


def lens(name: str, coefficients: tuple[float, ...] = ()) -> CameraModel:
    return camera_model(640, 480, name, coefficients, MATRIX)


@pytest.mark.parametrize("coefficients", [(0.0,) * 4, KANNALA])
def test_a_fisheye_projects_as_opencv_s_does(coefficients: tuple[float, ...]) -> None:
    points = np.random.default_rng(1).normal(size=(200, 3)) * (2, 2, 1) + (0, 0, 3)
    points = points[points[:, 2] > 0.2]
    expected, _ = cv2.fisheye.projectPoints(
        points[:, None], np.zeros(3), np.zeros(3), np.reshape(MATRIX, (3, 3)), np.array(coefficients)
    )
    np.testing.assert_allclose(
        lens("kannala_brandt", coefficients).project(points), expected[:, 0], atol=1e-6
    )


@pytest.mark.parametrize(
    ("name", "coefficients"),
    [
        ("plumb_bob", ()),
        ("plumb_bob", (-0.2, 0.05, 0.001, -0.002, 0.003)),
        ("rational_polynomial", (0.3, 0.05, 0.001, -0.002, 0.003, 0.5, 0.1, 0.01)),
    ],
)
def test_a_pinhole_projects_as_opencv_s_does(name: str, coefficients: tuple[float, ...]) -> None:
    points = np.random.default_rng(2).uniform((-1, -1, 2), (1, 1, 4), (100, 3))
    expected, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), np.reshape(MATRIX, (3, 3)), np.array(coefficients or (0.0,) * 5)
    )
    np.testing.assert_allclose(lens(name, coefficients).project(points), expected[:, 0], atol=1e-6)


def test_a_fisheye_sees_beside_and_behind_itself_and_a_pinhole_does_not() -> None:
    beside = np.array([[1.0, 0, 0], [1.0, 0, -0.3], [0, 0, -1.0]])
    assert np.isfinite(lens("equidistant").project(beside)[:2]).all()
    assert np.isnan(lens("plumb_bob").project(beside)).all()


def test_what_lies_beyond_a_lens_s_turning_point_is_not_seen() -> None:
    folding = lens("kannala_brandt", (-0.3, 0.0, 0.0, 0.0))  # theta - 0.3 theta^3 turns at 1.054 rad
    assert folding.largest_angle_rad() == pytest.approx(1 / math.sqrt(0.9), abs=2e-3)
    assert np.isnan(folding.project(np.array([[math.tan(1.1), 0, 1.0]]))).all()


def test_panning_left_and_tilting_up_look_there() -> None:
    left = VirtualView(pan_rad=0.5).camera_from_virtual() @ (0, 0, 1)
    up = VirtualView(tilt_rad=0.5).camera_from_virtual() @ (0, 0, 1)
    np.testing.assert_allclose(left, (-math.sin(0.5), 0, math.cos(0.5)))  # x is to the right
    np.testing.assert_allclose(up, (0, -math.sin(0.5), math.cos(0.5)))  # y is down


@pytest.mark.parametrize(("pan", "tilt"), list(product((-0.6, 0.0, 0.6), (-0.3, 0.4))))
def test_a_point_appears_where_a_straight_camera_would_show_it(pan: float, tilt: float) -> None:
    camera, view = lens("kannala_brandt", KANNALA), VirtualView(pan, tilt, math.radians(60), 256, 200)
    turn = view.camera_from_virtual()
    for x, y in ((-0.4, -0.3), (0.0, 0.0), (0.3, 0.2)):
        spot_x, spot_y = camera.project(turn @ np.array([x, y, 1.0]))
        columns, rows = np.meshgrid(np.arange(640), np.arange(480))
        blob = 250 * np.exp(-((columns - spot_x) ** 2 + (rows - spot_y) ** 2) / (2 * 2.5**2))
        seen = rectify(blob.astype(np.uint8), camera, view).astype(float)
        rows_seen, columns_seen = np.mgrid[: view.height_px, : view.width_px]
        found = (seen * columns_seen).sum() / seen.sum(), (seen * rows_seen).sum() / seen.sum()
        expected = x * view.focal_px + 127.5, y * view.focal_px + 99.5
        assert found == pytest.approx(expected, abs=0.5)


def test_straight_edges_of_the_scene_come_out_as_a_turned_pinhole_draws_them() -> None:
    boxes, half = build_scene(3), math.radians(55)
    fisheye = FisheyeRenderer(boxes, (640, 480), 2 * half, "indoor", 3)
    look = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    pose = transform(look, (0.5, 0.0, 1.4))
    calibration = Pinhole(640, 480, 640 / (2 * half)).matrix
    camera = camera_model(640, 480, "kannala_brandt", [0.0] * 4, calibration.ravel())
    view = VirtualView(math.radians(15), math.radians(10), math.radians(50), 200, 160)
    straight = Renderer(boxes, Pinhole(200, 160, view.focal_px), "indoor", 3)
    truth = straight.draw(transform(look @ view.camera_from_virtual(), (0.5, 0.0, 1.4)))
    seen = rectify(fisheye.expose(pose), camera, view)
    assert _correlation(seen, truth) > 0.9
    wrong = VirtualView(math.radians(13), math.radians(10), math.radians(50), 200, 160)
    assert (
        _correlation(rectify(fisheye.expose(pose), camera, wrong), truth) < _correlation(seen, truth) - 0.05
    )


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    blurred = [cv2.GaussianBlur(cv2.cvtColor(p, cv2.COLOR_BGR2GRAY), (5, 5), 0).ravel() for p in (a, b)]
    return float(np.corrcoef(*blurred)[0, 1])


def test_a_picture_of_half_the_calibrated_size_shows_the_same() -> None:
    camera, view = lens("equidistant"), VirtualView(0.2, 0.1, 1.0, 120, 100)
    picture = cv2.GaussianBlur(np.random.default_rng(3).integers(0, 255, (480, 640), np.uint8), (0, 0), 8)
    picture = cv2.normalize(picture, None, 0, 255, cv2.NORM_MINMAX)
    whole = rectify(picture, camera, view)
    half = rectify(cv2.resize(picture, (320, 240), interpolation=cv2.INTER_AREA), camera, view)
    misplaced = np.roll(half, 1, axis=1)
    difference, of_a_pixel = (np.abs(whole.astype(int) - other).mean() for other in (half, misplaced))
    assert difference < of_a_pixel / 4


def test_a_view_of_nothing_is_an_error_and_one_over_the_edge_is_black_there() -> None:
    camera = lens("equidistant")
    with pytest.raises(RequestError, match="pan_rad = 3"):
        rectify(np.full((480, 640), 200, np.uint8), camera, VirtualView(pan_rad=3.0, field_of_view_rad=0.5))
    partly = rectify(
        np.full((480, 640), 200, np.uint8), camera, VirtualView(pan_rad=1.2, field_of_view_rad=1.4)
    )
    assert (partly[:, 0] == 0).any() and (partly[:, -1] == 200).any()


@pytest.mark.parametrize(
    ("field", "value"), [("field_of_view_rad", 3.2), ("tilt_rad", 2.0), ("width_px", 0), ("height_px", 9999)]
)
def test_a_view_out_of_bounds_names_the_field(field: str, value: float) -> None:
    with pytest.raises(RequestError, match=f"{field} = .*must be within"):
        VirtualView(**{field: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"width_px": 0}, "width = 0"),
        ({"matrix": (1.0,) * 8}, "K has 8"),
        ({"matrix": (0.0,) * 9}, "focal lengths 0, 0"),
        ({"matrix": (math.nan,) * 9}, "finite"),
        ({"distortion": (0.1,) * 3}, "D has 3"),
        ({"distortion_model": "thin_prism"}, "distortion_model = 'thin_prism'"),
    ],
)
def test_a_calibration_that_cannot_be_is_refused_by_field(change: dict[str, object], named: str) -> None:
    fields: dict[str, object] = {
        "width_px": 640,
        "height_px": 480,
        "distortion_model": "plumb_bob",
        "distortion": (),
        "matrix": MATRIX,
    }
    with pytest.raises(NoDataError, match=named):
        camera_model(**(fields | change))  # type: ignore[arg-type]


@settings(max_examples=40)
@given(
    st.lists(st.floats(-1e3, 1e3), min_size=4, max_size=4),
    st.floats(-3.1, 3.1),
    st.floats(-1.5, 1.5),
    st.floats(0.05, 2.9),
)
def test_any_calibration_and_view_give_a_picture_or_an_error(
    coefficients: list[float], pan: float, tilt: float, field_of_view: float
) -> None:
    camera = camera_model(64, 48, "fisheye", coefficients, (30.0, 0, 32, 0, 30, 24, 0, 0, 1))
    try:
        seen = rectify(
            np.full((48, 64, 3), 9, np.uint8), camera, VirtualView(pan, tilt, field_of_view, 20, 16)
        )
    except RequestError:
        return
    assert seen.shape == (16, 20, 3)

"""The scene and the robot in it obey their physics: rays, motion, joints."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from straitlink.synthetic.camera import Pinhole, Renderer
from straitlink.synthetic.frames import (
    DYNAMIC_FRAMES,
    HEAD_FROM_HEAD_CAMERA,
    SPINDLE_FROM_LIDAR,
    dynamic_transforms,
    map_from_head,
    map_from_lidar,
)
from straitlink.synthetic.gait import (
    ANKLE_HEIGHT_M,
    STEP_RATE_HZ,
    foot_poses,
    stance_load_ratio,
    walking_pose,
)
from straitlink.synthetic.joints import (
    JOINT_LIMITS,
    LOWER_RAD,
    UPPER_RAD,
    VELOCITY_RADPS,
    joint_positions,
    joint_velocities,
)
from straitlink.synthetic.lidar import BEAMS, BoxField, Rays, Scanner
from straitlink.synthetic.occlusion import Occlusion
from straitlink.synthetic.rigid import FloatArray, quaternion_from_rotation, rotation_from_rpy
from straitlink.synthetic.scene import Box, build_scene

SCENE = build_scene(1)


def ray_box_range(origin: FloatArray, direction: FloatArray, box: Box) -> float:
    """The textbook way, one ray and one box at a time: where the ray meets each of the six faces."""
    local_origin = box.map_from_box.T @ (origin - np.array(box.centre_m))
    local_direction = box.map_from_box.T @ direction
    half = np.array(box.size_m) / 2
    nearest = np.inf
    for axis in range(3):
        for side in (-half[axis], half[axis]):
            if abs(local_direction[axis]) < 1e-12:
                continue
            distance = (side - local_origin[axis]) / local_direction[axis]
            hit = local_origin + distance * local_direction
            others = [other for other in range(3) if other != axis]
            if distance > 0 and all(abs(hit[other]) <= half[other] + 1e-9 for other in others):
                nearest = min(nearest, float(distance))
    return nearest


def test_one_box_straight_ahead_is_as_far_as_its_face() -> None:
    box = Box("block", (3.0, 0.0, 0.0), (0.4, 0.4, 0.4), np.eye(3))
    rays = Rays(np.zeros((2, 3)), np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))
    ranges, strengths = BoxField([box]).cast(rays)
    assert ranges[0] == pytest.approx(2.8, abs=1e-12)
    assert np.isinf(ranges[1])
    assert strengths[0] > 0 == strengths[1]


@pytest.mark.parametrize("start_s", [0.0, 7.31, 44.0])
def test_beams_measure_the_exact_distance_to_the_nearest_box(start_s: float) -> None:
    scanner = Scanner(SCENE, seed=1)
    ranges, _ = scanner.true_ranges(start_s)
    rays = scanner.rays(start_s)
    for beam in range(0, BEAMS, 29):
        truth = min(ray_box_range(rays.origins_m[beam], rays.directions[beam], box) for box in SCENE)
        if np.isinf(truth):
            assert np.isinf(ranges[beam])
        else:
            assert ranges[beam] == pytest.approx(truth, abs=1e-9)


@given(start_s=st.floats(0.0, 600.0))
def test_leaving_out_boxes_far_from_the_scan_changes_nothing(start_s: float) -> None:
    scanner = Scanner(SCENE, seed=1, beams=271)
    culled, _ = scanner.true_ranges(start_s)
    everything, _ = BoxField(SCENE).cast(scanner.rays(start_s))
    np.testing.assert_array_equal(culled, everything)


def test_each_beam_leaves_from_the_pose_at_its_own_instant() -> None:
    scanner = Scanner(SCENE, seed=1)
    start_s = 20.0
    rays = scanner.rays(start_s)
    for beam in (0, 333, 700, BEAMS - 1):
        at = np.array([start_s + scanner.beam_offsets_s[beam]])
        pose = map_from_lidar(at, 1)[0]
        angle = scanner.angles_rad[beam]
        expected = pose[:3, :3] @ [np.cos(angle), np.sin(angle), 0.0]
        np.testing.assert_allclose(rays.directions[beam], expected, atol=2e-6)
        np.testing.assert_allclose(rays.origins_m[beam], pose[:3, 3], atol=2e-6)


def test_motion_within_a_scan_moves_the_points() -> None:
    scanner = Scanner(SCENE, seed=1)
    start_s = 20.0
    rays, ranges = scanner.rays(start_s), scanner.true_ranges(start_s)[0]
    pose = map_from_lidar(np.array([start_s]), 1)[0]
    angles = scanner.angles_rad
    in_lidar = np.stack([np.cos(angles), np.sin(angles), np.zeros(BEAMS)], axis=1)
    hit = np.isfinite(ranges)
    true_points = rays.origins_m[hit] + rays.directions[hit] * ranges[hit, None]
    frozen_points = (in_lidar[hit] * ranges[hit, None]) @ pose[:3, :3].T + pose[:3, 3]
    displacement_m = np.linalg.norm(true_points - frozen_points, axis=1)
    # The spindle turns by 9.8 mrad in the 18.75 ms between the first beam and the last, the body by
    # less than a tenth of that, and walking adds less than 5 mm.
    bound_m = 0.0108 * ranges[hit] + 0.005
    assert (displacement_m < bound_m).all()
    assert displacement_m.max() > 0.01


def test_the_spindle_makes_five_turns_a_minute() -> None:
    spindle = DYNAMIC_FRAMES.index(("head", "spindle"))
    start, quarter = dynamic_transforms(np.array([0.0, 3.0]), 1)[:, spindle, :3, :3]
    np.testing.assert_allclose(start, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(quarter @ [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], atol=1e-12)


def test_the_published_frames_chain_to_the_pose_that_the_scanner_uses() -> None:
    times_s = np.array([0.0, 12.3, 77.0])
    chain = dynamic_transforms(times_s, 1)
    pose = chain[:, 0] @ chain[:, 1] @ chain[:, 2] @ chain[:, 3] @ chain[:, 4] @ SPINDLE_FROM_LIDAR
    np.testing.assert_allclose(pose, map_from_lidar(times_s, 1), atol=1e-12)


@given(seed=st.integers(0, 2**63 - 1), start_s=st.floats(0.0, 86_400.0))
def test_joints_keep_within_the_limits_of_the_robot(seed: int, start_s: float) -> None:
    times_s = start_s + np.arange(0.0, 3.0, 0.02)
    positions = joint_positions(times_s, seed)
    assert positions.shape == (times_s.size, len(JOINT_LIMITS)) == (times_s.size, 28)
    assert (positions >= LOWER_RAD).all()
    assert (positions <= UPPER_RAD).all()
    assert (np.abs(joint_velocities(times_s, seed)) <= VELOCITY_RADPS).all()


def test_velocities_are_the_rate_of_the_positions() -> None:
    times_s = np.arange(10.0, 14.0, 0.003)
    moved = np.diff(joint_positions(times_s, 1), axis=0)
    mean = joint_velocities(times_s[:-1] + 0.0015, 1) * 0.003
    np.testing.assert_allclose(moved, mean, atol=2e-4)


def test_the_body_bobs_once_per_step() -> None:
    times_s = np.arange(0.0, 100.0, 0.05)
    height = walking_pose(times_s)[:, 2, 3]
    spectrum = np.abs(np.fft.rfft(height - height.mean()))
    frequency_hz = np.fft.rfftfreq(times_s.size, 0.05)[spectrum.argmax()]
    assert frequency_hz == pytest.approx(STEP_RATE_HZ, abs=0.01)


def test_a_foot_that_carries_weight_stands_still_on_the_ground() -> None:
    times_s = np.arange(0.0, 30.0, 0.005)
    for left in (True, False):
        place = foot_poses(times_s, left=left)[:, :3, 3]
        loaded = stance_load_ratio(times_s, left=left) > 0
        assert np.abs(place[loaded, 2] - ANKLE_HEIGHT_M).max() < 1e-9
        both = loaded[1:] & loaded[:-1]
        assert np.abs(np.diff(place, axis=0)[both]).max() < 1e-9


def test_the_feet_share_the_whole_weight() -> None:
    times_s = np.arange(0.0, 10.0, 0.01)
    total = stance_load_ratio(times_s, left=True) + stance_load_ratio(times_s, left=False)
    np.testing.assert_allclose(total, 1.0, atol=1e-9)


@given(st.tuples(*[st.floats(-3.14, 3.14)] * 3))
def test_a_quaternion_says_the_same_as_its_rotation(rpy: tuple[float, float, float]) -> None:
    rotation = rotation_from_rpy(*rpy)
    x, y, z, w = quaternion_from_rotation(rotation)
    assert x * x + y * y + z * z + w * w == pytest.approx(1.0)
    axis, vector = np.array([x, y, z]), np.array([0.3, -0.5, 0.8])
    turned = vector + 2 * np.cross(axis, np.cross(axis, vector) + w * vector)
    np.testing.assert_allclose(turned, rotation @ vector, atol=1e-9)


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("time_s", [2.0, 14.0, 30.0, 60.0])
def test_the_camera_sees_what_the_rays_hit(seed: int, time_s: float) -> None:
    scene, camera = build_scene(seed), Pinhole(640, 340, 381.0)
    renderer = Renderer(scene, camera, "indoor", seed)
    pose = (map_from_head(np.array([time_s]), seed) @ HEAD_FROM_HEAD_CAMERA)[0]
    frame = renderer.draw(pose).copy()
    assert frame.std() > 10  # a picture, not one colour
    rows, columns = np.mgrid[4:340:12, 4:640:12]
    middle = camera.matrix[:2, 2]
    optical = np.stack(
        [
            (columns.ravel() - middle[0]) / camera.focal_pixels,
            (rows.ravel() - middle[1]) / camera.focal_pixels,
            np.ones(rows.size),
        ],
        axis=1,
    )
    directions = optical @ pose[:3, :3].T
    origins = np.broadcast_to(pose[:3, 3], directions.shape)
    truth, _ = BoxField(scene).cast(Rays(np.array(origins), directions))  # not unit: range = depth
    drawn = renderer.depth_m()[rows.ravel(), columns.ravel()]
    # Where not, it is a pixel on an outline, or one of the few places where two boxes intersect.
    agree = np.isclose(truth, drawn, rtol=0.01)
    assert agree.mean() > 0.98


def test_a_box_is_painted_after_those_that_it_hides() -> None:
    eye_m = np.array([0.0, 0.0, 1.5])
    everywhere = np.tile([0, 0, 100, 100], (3, 1))
    wall = Box("wall", (5.0, 0.0, 1.0), (0.2, 8.0, 2.0), np.eye(3))
    # Its middle is further from the eye than the wall's, which it stands in front of.
    beam = Box("debris", (4.5, 3.5, 0.1), (0.2, 0.2, 0.2), np.eye(3))
    on_top = Box("block", (4.5, 3.5, 0.3), (0.4, 0.4, 0.2), rotation_from_rpy(0.0, 0.0, 0.7))
    order = Occlusion([on_top, beam, wall]).far_to_near(eye_m, np.arange(3), everywhere)
    assert order.tolist() == [2, 1, 0]
    seen_from_below = Occlusion([on_top, beam, wall]).far_to_near(
        np.array([0.0, 0.0, -9.0]), np.arange(3), everywhere
    )
    assert seen_from_below.tolist() == [2, 0, 1]


def test_another_seed_is_another_scene_with_the_same_valve() -> None:
    other = build_scene(2)
    assert [box for box in other if box.kind == "block"] != [box for box in SCENE if box.kind == "block"]
    centres = [[box.centre_m for box in scene if box.kind == "valve"] for scene in (SCENE, other)]
    assert centres[0] == centres[1]

"""Poses between samples, chains of frames, and what snapshots keep."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perception_server.errors import PoseError
from perception_server.frames import (
    Frames,
    StampedTransform,
    compose,
    interpolate,
    inverse_poses,
    matrices,
    rotate,
)

S = 1_000_000_000
HALF = float(np.sqrt(0.5))


def stamped(stamp_s: float, parent: str, child: str, *pose: float, static: bool = False) -> StampedTransform:
    translation_and_turn = (*pose, *(0.0, 0.0, 0.0, 1.0)[len(pose) - 3 :]) if len(pose) < 7 else pose
    return StampedTransform(round(stamp_s * S), parent, child, tuple(translation_and_turn), static)  # type: ignore[arg-type]


def frames(*samples: StampedTransform, max_age_s: float = 100, max_gap_s: float = 10) -> Frames:
    tree = Frames(round(max_age_s * S), round(max_gap_s * S), max_frames=16)
    for sample in samples:
        tree.insert(sample)
    return tree


@st.composite
def poses(draw: st.DrawFn) -> np.ndarray:
    random = np.random.default_rng(draw(st.integers(0, 2**32)))
    turn = random.normal(size=4)
    return np.concatenate([random.uniform(-100, 100, 3), turn / np.linalg.norm(turn)])


@given(poses(), poses())
def test_composition_is_the_product_of_matrices(first: np.ndarray, second: np.ndarray) -> None:
    np.testing.assert_allclose(
        matrices(compose(first, second)), matrices(first) @ matrices(second), atol=1e-10
    )
    np.testing.assert_allclose(matrices(inverse_poses(first)), np.linalg.inv(matrices(first)), atol=1e-10)


@given(poses(), poses(), st.floats(0, 1))
def test_a_turn_proceeds_at_constant_rate_the_shorter_way(
    first: np.ndarray, second: np.ndarray, ratio: float
) -> None:
    between = interpolate(first[None], second[None], np.array([ratio]))[0]
    whole = 2 * np.arccos(min(1.0, abs(float(first[3:] @ second[3:]))))
    part = 2 * np.arccos(min(1.0, abs(float(first[3:] @ between[3:]))))
    assert part == pytest.approx(ratio * whole, abs=1e-6)
    np.testing.assert_allclose(between[:3], first[:3] + ratio * (second[:3] - first[:3]), atol=1e-9)


def test_a_spindle_between_two_samples_has_turned_by_its_share() -> None:
    tree = frames(
        stamped(1, "head", "lidar", 0, 0, 1, 0, 0, 0, 1),
        stamped(2, "head", "lidar", 0, 0, 1, HALF, 0, 0, HALF),
    ).snapshot()
    pose = tree.poses("head", "lidar", np.array([round(1.5 * S)]))
    up = rotate(pose[:, 3:], np.array([[0.0, 0.0, 1.0]]))[0]
    np.testing.assert_allclose(up, [0, -np.sin(np.pi / 4), np.cos(np.pi / 4)], atol=1e-9)


def test_a_chain_leads_up_one_branch_and_down_another() -> None:
    tree = frames(
        stamped(0, "map", "base", 1, 0, 0, static=True),
        stamped(0, "base", "head", 0, 0, 2, 0, 0, HALF, HALF, static=True),
        stamped(0, "base", "hand", 0, 3, 0, static=True),
    ).snapshot()
    hand_from_head = tree.matrix("hand", "head", 5)
    np.testing.assert_allclose(hand_from_head @ [1, 0, 0, 1], [0, -2, 2, 1], atol=1e-12)
    np.testing.assert_allclose(tree.matrix("head", "hand", 5) @ hand_from_head, np.eye(4), atol=1e-12)


@pytest.mark.parametrize(
    ("at_s", "why"), [(0.5, "known from"), (9.5, "known from"), (5.0, "gap"), (2.5, None)]
)
def test_no_pose_is_made_up_outside_the_samples_or_in_a_long_gap(at_s: float, why: str | None) -> None:
    tree = frames(*(stamped(t, "map", "base", t, 0, 0) for t in (1, 2, 3, 7, 8, 9)), max_gap_s=3).snapshot()
    if why is None:
        assert tree.matrix("map", "base", round(at_s * S))[0, 3] == pytest.approx(at_s)
    else:
        with pytest.raises(PoseError, match=why):
            tree.matrix("map", "base", round(at_s * S))


def test_frames_that_nothing_connects_are_an_error_and_so_is_a_loop() -> None:
    tree = frames(stamped(0, "a", "b", 0, 0, 0, static=True), stamped(0, "c", "d", 0, 0, 0, static=True))
    with pytest.raises(PoseError, match="no transform connects"):
        tree.snapshot().matrix("a", "d", 0)
    tree.insert(stamped(0, "b", "a", 0, 0, 0, static=True))
    with pytest.raises(PoseError, match="loop"):
        tree.snapshot().matrix("a", "c", 0)


def test_a_snapshot_is_not_changed_by_what_comes_after() -> None:
    tree = frames(stamped(0, "map", "base", 0, 0, 0))
    tree.insert(stamped(1, "map", "base", 1, 0, 0))
    before = tree.snapshot()
    poses_before = before.tracks["base"].poses.copy()
    for t in range(2, 2000):
        tree.insert(stamped(t, "map", "base", t, 0, 0))
    np.testing.assert_array_equal(before.tracks["base"].poses, poses_before)
    now = tree.snapshot().tracks["base"]
    assert now.span_ns == (1899 * S, 1999 * S)
    assert now.times_ns.base is not None and now.times_ns.base.size <= 512


def test_old_unfinite_and_surplus_transforms_are_counted_and_left_out() -> None:
    tree = frames(stamped(5, "map", "base", 0, 0, 0))
    assert not tree.insert(stamped(5, "map", "base", 9, 0, 0))
    assert not tree.insert(stamped(6, "map", "base", float("nan"), 0, 0))
    assert not tree.insert(stamped(6, "map", "base", 0, 0, 0, 0, 0, 0, 0))
    for i in range(20):
        tree.insert(stamped(6, "map", f"frame{i}", 0, 0, 0))
    assert tree.refused == 3 + 5
    assert len(tree.snapshot().tracks) == 16

"""Frames and their motion: SE(3), interpolation in time, and the tree of frames as it was.

Poses are 4x4 float64 matrices named target_from_source, or rows of seven: translation in metres, then a
unit quaternion x, y, z, w (REP-103). Times are integer nanoseconds since the Unix epoch on the robot's
clock.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from perception_server.errors import PoseError

FloatArray = NDArray[np.float64]
TimeArray = NDArray[np.int64]

_FOREVER_NS = np.iinfo(np.int64).max
_FIRST_ROWS = 256
_MAX_DEPTH = 64  # of a chain of frames; a longer one is a loop


@dataclass(frozen=True, slots=True)
class StampedTransform:
    """parent_from_child at one instant, or for all times if is_static.

    pose: translation x, y, z in metres, then a quaternion x, y, z, w of any length but zero.
    """

    stamp_ns: int
    parent: str
    child: str
    pose: tuple[float, float, float, float, float, float, float]
    is_static: bool = False


def matrices(poses: ArrayLike) -> FloatArray:
    """(..., 4, 4) from (..., 7)."""
    rows = np.asarray(poses, dtype=np.float64)
    x, y, z, w = (rows[..., i] for i in range(3, 7))
    matrix = np.zeros((*rows.shape[:-1], 4, 4))
    matrix[..., 0, 0] = 1 - 2 * (y * y + z * z)
    matrix[..., 0, 1] = 2 * (x * y - z * w)
    matrix[..., 0, 2] = 2 * (x * z + y * w)
    matrix[..., 1, 0] = 2 * (x * y + z * w)
    matrix[..., 1, 1] = 1 - 2 * (x * x + z * z)
    matrix[..., 1, 2] = 2 * (y * z - x * w)
    matrix[..., 2, 0] = 2 * (x * z - y * w)
    matrix[..., 2, 1] = 2 * (y * z + x * w)
    matrix[..., 2, 2] = 1 - 2 * (x * x + y * y)
    matrix[..., :3, 3] = rows[..., :3]
    matrix[..., 3, 3] = 1.0
    return matrix


def inverse_poses(poses: FloatArray) -> FloatArray:
    """(..., 7): source_from_target for each target_from_source."""
    out = poses.copy()
    out[..., 3:6] *= -1
    out[..., :3] = -rotate(out[..., 3:], poses[..., :3])
    return out


def compose(first: FloatArray, second: FloatArray) -> FloatArray:
    """(..., 7): a_from_c of a_from_b and b_from_c."""
    ax, ay, az, aw = (first[..., i] for i in range(3, 7))
    bx, by, bz, bw = (second[..., i] for i in range(3, 7))
    rotation = np.stack(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ],
        axis=-1,
    )
    translation = first[..., :3] + rotate(first[..., 3:], second[..., :3])
    return np.concatenate([translation, rotation], axis=-1)


def rotate(quaternion: FloatArray, vector: FloatArray) -> FloatArray:
    """(..., 3): vectors turned by unit quaternions x, y, z, w."""
    axis, w = quaternion[..., :3], quaternion[..., 3:]
    twice = 2.0 * _cross(axis, vector)
    turned: FloatArray = vector + w * twice + _cross(axis, twice)
    return turned


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    # np.cross takes five times as long on short arrays.
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def interpolate(before: FloatArray, after: FloatArray, ratio: FloatArray) -> FloatArray:
    """(K, 7): poses at ratio 0..1 between two; straight in translation, slerp in rotation.

    Source: Shoemake, SIGGRAPH 1985. The shorter way round is taken.
    """
    turn, other = before[:, 3:], after[:, 3:]
    cosine = np.einsum("ki,ki->k", turn, other)
    other = np.where(cosine[:, None] < 0, -other, other)
    angle = np.arccos(np.minimum(np.abs(cosine), 1.0))
    sine = np.sin(angle)
    close = sine < 1e-6  # there slerp and a straight line agree to 1e-12
    divisor = np.where(close, 1.0, sine)
    share_before = np.where(close, 1 - ratio, np.sin((1 - ratio) * angle) / divisor)
    share_after = np.where(close, ratio, np.sin(ratio * angle) / divisor)
    rotation = turn * share_before[:, None] + other * share_after[:, None]
    rotation /= np.sqrt(np.einsum("ki,ki->k", rotation, rotation))[:, None]
    translation = before[:, :3] + (after[:, :3] - before[:, :3]) * ratio[:, None]
    return np.concatenate([translation, rotation], axis=1)


@dataclass(frozen=True, slots=True)
class PoseTrack:
    """One edge of the tree over time: parent_from_child at times_ns (N,), ascending; poses (N, 7).

    A static edge has one row, which holds at all times.
    """

    parent: str
    times_ns: TimeArray
    poses: FloatArray
    is_static: bool

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last time at which the edge is known."""
        if self.is_static:
            return (0, _FOREVER_NS)
        return (int(self.times_ns[0]), int(self.times_ns[-1]))

    def at(self, times_ns: TimeArray, max_gap_ns: int) -> FloatArray:
        """(K, 7) at each time. Raises PoseError outside the track, or in a gap longer than max_gap_ns."""
        if self.is_static:
            return np.broadcast_to(self.poses[0], (times_ns.size, 7))
        first, last = self.span_ns
        if times_ns.size and (times_ns.min() < first or times_ns.max() > last):
            raise PoseError(f"the pose in {self.parent} is known from {first} to {last} ns, not at all times")
        after = np.clip(np.searchsorted(self.times_ns, times_ns), 1, max(1, self.times_ns.size - 1))
        after = np.minimum(after, self.times_ns.size - 1)
        before = np.maximum(after - 1, 0)
        gap_ns = self.times_ns[after] - self.times_ns[before]
        if gap_ns.size and gap_ns.max() > max_gap_ns:
            raise PoseError(f"the pose in {self.parent} has a gap of {gap_ns.max()} ns, above {max_gap_ns}")
        ratio = (times_ns - self.times_ns[before]) / np.maximum(gap_ns, 1)
        return interpolate(self.poses[before], self.poses[after], ratio)


@dataclass(frozen=True, slots=True)
class FrameTree:
    """Every edge as it was when the snapshot was taken: child -> track. Never changes.

    max_gap_ns: between two samples of an edge; poses in a longer gap count as unknown.
    """

    tracks: Mapping[str, PoseTrack] = field(default_factory=dict)
    max_gap_ns: int = 2_000_000_000

    def poses(self, target: str, source: str, times_ns: TimeArray) -> FloatArray:
        """(K, 7) target_from_source at each time. Raises PoseError."""
        up, down = self._chain(target, source)
        result = np.tile(np.array([0, 0, 0, 0, 0, 0, 1.0]), (times_ns.size, 1))
        for child in reversed(up):  # from the common ancestor down to the source
            result = compose(result, self.tracks[child].at(times_ns, self.max_gap_ns))
        above = np.tile(np.array([0, 0, 0, 0, 0, 0, 1.0]), (times_ns.size, 1))
        for child in reversed(down):
            above = compose(above, self.tracks[child].at(times_ns, self.max_gap_ns))
        return compose(inverse_poses(above), result) if down else result

    def matrix(self, target: str, source: str, time_ns: int) -> FloatArray:
        """(4, 4) target_from_source at one time. Raises PoseError."""
        matrix: FloatArray = matrices(self.poses(target, source, np.array([time_ns])))[0]
        return matrix

    def span_ns(self, target: str, source: str) -> tuple[int, int]:
        """The times at which every edge between the two is known. Raises PoseError if not connected."""
        up, down = self._chain(target, source)
        spans = [self.tracks[child].span_ns for child in (*up, *down)]
        return (
            max((first for first, _ in spans), default=0),
            min((last for _, last in spans), default=_FOREVER_NS),
        )

    def times_ns(self, target: str, source: str, start_ns: int, end_ns: int) -> TimeArray:
        """When within start..end some moving edge between the two was sampled; start and end too.

        Between neighbours of these every edge moves as interpolated, so that a chain needs to be worked
        out at these times only. Raises PoseError.
        """
        up, down = self._chain(target, source)
        inside = [np.array([start_ns, end_ns], dtype=np.int64)]
        for child in (*up, *down):
            track = self.tracks[child]
            if not track.is_static:
                first, last = np.searchsorted(track.times_ns, (start_ns, end_ns))
                inside.append(track.times_ns[first:last])
        return np.unique(np.concatenate(inside))

    def _chain(self, target: str, source: str) -> tuple[list[str], list[str]]:
        """Children whose edges lead from the source, and from the target, up to their first common frame."""
        up, down = self._ancestors(source), self._ancestors(target)
        shared = set(up) & set(down)
        if not shared:
            raise PoseError(f"no transform connects {source!r} with {target!r}")
        meet_up = next(i for i, name in enumerate(up) if name in shared)
        return up[:meet_up], down[: down.index(up[meet_up])]

    def _ancestors(self, frame: str) -> list[str]:
        names = [frame]
        while (track := self.tracks.get(names[-1])) is not None:
            names.append(track.parent)
            if len(names) > _MAX_DEPTH:
                raise PoseError(f"the frames above {frame!r} form a loop")
        return names


class PoseRing:
    """One edge's samples of the last while, appended in order of time; earlier ones are left out.

    A snapshot shares the arrays: rows below its end never change, so readers in other threads need no
    lock.
    """

    def __init__(self, parent: str, max_age_ns: int) -> None:
        self._max_age_ns = max_age_ns
        self._times_ns = np.empty(_FIRST_ROWS, dtype=np.int64)
        self._poses = np.empty((_FIRST_ROWS, 7))
        self._first = self._stop = 0
        self.track = PoseTrack(parent, self._times_ns[:0], self._poses[:0], is_static=False)

    def append(self, sample: StampedTransform) -> bool:
        """Take a sample; False if it is not newer than the last one. A new parent starts afresh."""
        if sample.parent != self.track.parent:
            self._first = self._stop
        elif self._stop > self._first and sample.stamp_ns <= self._times_ns[self._stop - 1]:
            return False
        if self._stop == self._times_ns.size:
            self._make_room()
        self._times_ns[self._stop] = sample.stamp_ns
        self._poses[self._stop] = sample.pose
        self._stop += 1
        while self._times_ns[self._first] < sample.stamp_ns - self._max_age_ns:
            self._first += 1
        rows = slice(self._first, self._stop)
        self.track = PoseTrack(sample.parent, self._times_ns[rows], self._poses[rows], is_static=False)
        return True

    def _make_room(self) -> None:
        # Into new arrays: snapshots may still read the old ones.
        kept = self._stop - self._first
        times_ns, poses = self._times_ns, self._poses
        self._times_ns = np.empty(max(_FIRST_ROWS, 2 * kept), dtype=np.int64)
        self._poses = np.empty((self._times_ns.size, 7))
        self._times_ns[:kept] = times_ns[self._first : self._stop]
        self._poses[:kept] = poses[self._first : self._stop]
        self._first, self._stop = 0, kept


class Frames:
    """The growing tree: takes transforms, gives snapshots."""

    def __init__(self, max_age_ns: int, max_gap_ns: int, max_frames: int) -> None:
        self._max_age_ns = max_age_ns
        self._max_gap_ns = max_gap_ns
        self._max_frames = max_frames
        self._rings: dict[str, PoseRing] = {}
        self._static: dict[str, PoseTrack] = {}
        self.refused = 0

    def insert(self, sample: StampedTransform) -> bool:
        """Take one transform; False, counted, if it is old, is no rotation, or is one frame too many."""
        pose = np.array(sample.pose, dtype=np.float64)
        norm = float(np.sqrt(pose[3:] @ pose[3:]))
        known = sample.child in self._rings or sample.child in self._static
        full = not known and len(self._rings) + len(self._static) >= self._max_frames
        if full or not np.isfinite(pose).all() or norm < 1e-3 or sample.parent == sample.child:
            self.refused += 1
            return False
        pose[3:] /= norm
        if sample.is_static:
            self._rings.pop(sample.child, None)
            self._static[sample.child] = PoseTrack(
                sample.parent, np.zeros(1, np.int64), pose[None], is_static=True
            )
            return True
        self._static.pop(sample.child, None)
        ring = self._rings.get(sample.child)
        if ring is None:
            ring = self._rings[sample.child] = PoseRing(sample.parent, self._max_age_ns)
        unit = StampedTransform(sample.stamp_ns, sample.parent, sample.child, tuple(pose.tolist()))
        taken = ring.append(unit)
        self.refused += not taken
        return taken

    def snapshot(self) -> FrameTree:
        """The tree as it is now; cheap, and safe while another thread inserts."""
        tracks = dict(self._static)
        for child, ring in self._rings.copy().items():
            if ring.track.times_ns.size:
                tracks[child] = ring.track
        return FrameTree(tracks, self._max_gap_ns)

"""From a scanner's ranges to points in the world: one pose per beam, and which returns to doubt."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from perception_server.frames import FloatArray, FrameTree, compose, interpolate, matrices, rotate
from perception_server.point_ring import MIXED, ON_ROBOT, Flags, PlacedScan

_MAX_KNOTS = 64  # of the pose over one scan
# A return is mixed if the surface through it and both its neighbours would be seen at less than this.
_MIXED_GRAZING_RAD = np.deg2rad(8.0)
_IDENTITY = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


@dataclass(frozen=True, slots=True)
class RawScan:
    """One turn of a planar scanner, as its driver published it.

    sensor: the key that it came on. start_ns: capture time of the first beam.
    ranges_m: (N,) beams in order; anything not finite or outside min..max is no return (REP-117).
    beam_period_ns: between neighbouring beams. frame_from_scanner: where the scan's plane lies in frame_id.
    """

    sensor: str
    frame_id: str
    start_ns: int
    beam_period_ns: float
    angle_min_rad: float
    angle_step_rad: float
    ranges_m: NDArray[np.float32]
    min_range_m: float = 0.0
    max_range_m: float = np.inf
    frame_from_scanner: tuple[float, float, float, float, float, float, float] = _IDENTITY

    @property
    def end_ns(self) -> int:
        """Capture time of the last beam."""
        return self.start_ns + round(self.beam_period_ns * max(0, self.ranges_m.size - 1))


@dataclass(frozen=True, slots=True)
class RawCloud:
    """A point cloud as its driver published it.

    points_m: (N, 3) float32 in frame_id; rows that are not finite are no return.
    """

    sensor: str
    frame_id: str
    start_ns: int
    points_m: NDArray[np.float32]

    @property
    def end_ns(self) -> int:
        """All points count as taken at the stamp."""
        return self.start_ns


@dataclass(frozen=True, slots=True)
class SelfBox:
    """A part of the robot: returns inside this box of a frame are on the robot itself. Metres."""

    frame_id: str
    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class ScanPlacement:
    """What placing needs beside the poses.

    world: the fixed frame. sweep_frame: against which a spindle's turning is told, such as "head";
    "" is the fixed frame. self_boxes: the self-filter.
    """

    world: str = "map"
    sweep_frame: str = ""
    self_boxes: tuple[SelfBox, ...] = field(default=())


def place_scan(scan: RawScan, tree: FrameTree, placement: ScanPlacement) -> PlacedScan:
    """Put every return where its beam met the world. Raises PoseError if some pose is not known.

    The chain of frames is worked out where one of its edges was sampled, and interpolated to each
    beam's own instant between those.
    """
    ranges = scan.ranges_m.astype(np.float64)
    valid = np.flatnonzero(np.isfinite(ranges) & (ranges >= scan.min_range_m) & (ranges <= scan.max_range_m))
    knots_ns = _knots_ns(scan, tree, placement.world)
    knots = tree.poses(placement.world, scan.frame_id, knots_ns)
    knots = compose(knots, np.broadcast_to(np.asarray(scan.frame_from_scanner), knots.shape))
    poses = _at_beams(knots_ns - scan.start_ns, knots, valid.astype(np.float64) * scan.beam_period_ns)
    angle = scan.angle_min_rad + scan.angle_step_rad * valid
    reach = ranges[valid]
    local = np.stack([reach * np.cos(angle), reach * np.sin(angle), np.zeros(valid.size)], axis=-1)
    origin = knots[len(knots) // 2, :3].copy()
    world = rotate(poses[:, 3:], local) + poses[:, :3]
    flags = _mixed(reach, valid, scan.angle_step_rad)
    middle_ns = (scan.start_ns + scan.end_ns) // 2
    flags |= _on_robot(world, middle_ns, tree, placement)
    return PlacedScan(
        scan.sensor,
        scan.start_ns,
        scan.end_ns,
        origin,
        (world - origin).astype(np.float32),
        flags,
        _plane_normal(scan, middle_ns, tree, placement),
    )


def place_cloud(cloud: RawCloud, tree: FrameTree, placement: ScanPlacement) -> PlacedScan:
    """Put a cloud into the world at its stamp's pose. Raises PoseError if that is not known."""
    points = cloud.points_m[np.isfinite(cloud.points_m).all(axis=1)].astype(np.float64)
    world_from_cloud = tree.matrix(placement.world, cloud.frame_id, cloud.start_ns)
    turned = points @ world_from_cloud[:3, :3].T
    origin = world_from_cloud[:3, 3].copy()
    flags = _on_robot(turned + origin, cloud.start_ns, tree, placement)
    return PlacedScan(
        cloud.sensor, cloud.start_ns, cloud.end_ns, origin, turned.astype(np.float32), flags, np.zeros(3)
    )


def _knots_ns(scan: RawScan, tree: FrameTree, world: str) -> NDArray[np.int64]:
    knots_ns = tree.times_ns(world, scan.frame_id, scan.start_ns, scan.end_ns)
    if knots_ns.size > _MAX_KNOTS:  # several fast sources of poses, out of step with each other
        knots_ns = knots_ns[np.linspace(0, knots_ns.size - 1, _MAX_KNOTS).astype(np.intp)]
    return knots_ns


def _at_beams(knots_ns: NDArray[np.int64], knots: FloatArray, beams_ns: FloatArray) -> FloatArray:
    """(N, 7): the pose at each beam; times relative to the scan's start, where float64 is exact."""
    if len(knots) == 1:
        return np.broadcast_to(knots[0], (beams_ns.size, 7))
    after = np.clip(np.searchsorted(knots_ns, beams_ns), 1, len(knots) - 1)
    before = after - 1
    ratio = np.clip((beams_ns - knots_ns[before]) / (knots_ns[after] - knots_ns[before]), 0.0, 1.0)
    return interpolate(knots[before], knots[after], ratio)


def _mixed(ranges_m: FloatArray, beams: NDArray[np.intp], step_rad: float) -> Flags:
    """(N,): MIXED where a return continues neither neighbour's surface: a jump on both sides, one way.

    The edge of a beam that meets a near surface, the rest a far one: the device reports a range between.
    """
    flags = np.zeros(ranges_m.size, dtype=np.uint8)
    if ranges_m.size < 3:
        return flags
    jump = np.diff(ranges_m)
    gap_rad = np.diff(beams) * abs(step_rad)
    # Seen at a grazing angle g, neighbours a small angle d apart differ by about r d / tan(g).
    limit = ranges_m[:-1] * gap_rad / np.tan(_MIXED_GRAZING_RAD) + 0.03
    jumps = np.where(np.abs(jump) > limit, np.sign(jump), 0.0)
    flags[1:-1][(jumps[:-1] != 0) & (jumps[:-1] == jumps[1:])] = MIXED
    return flags


def _on_robot(world_m: FloatArray, time_ns: int, tree: FrameTree, placement: ScanPlacement) -> Flags:
    """(N,): ON_ROBOT for points inside a part of the robot, where that was at time_ns."""
    inside = np.zeros(len(world_m), dtype=bool)
    for box in placement.self_boxes:
        box_from_world = tree.matrix(box.frame_id, placement.world, time_ns)
        points = world_m @ box_from_world[:3, :3].T + box_from_world[:3, 3]
        inside |= ((points >= box.low_m) & (points <= box.high_m)).all(axis=1)
    return inside.astype(np.uint8) * np.uint8(ON_ROBOT)


def _plane_normal(scan: RawScan, time_ns: int, tree: FrameTree, placement: ScanPlacement) -> FloatArray:
    frame = placement.sweep_frame or placement.world
    pose = compose(
        tree.poses(frame, scan.frame_id, np.array([time_ns])), np.asarray(scan.frame_from_scanner)[None]
    )
    normal: FloatArray = matrices(pose)[0, :3, 2].copy()
    return normal

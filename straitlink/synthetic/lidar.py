"""The scanner on its turning spindle: rays against the scene's boxes, one pose per beam."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from straitlink.synthetic.frames import map_from_lidar
from straitlink.synthetic.rigid import FloatArray
from straitlink.synthetic.scene import Box

# A Hokuyo UTM-30LX-EW, as in the MultiSense SL: 40 turns a second, 1,081 beams over 270 degrees,
# 0.1 to 30 m, +-10 mm (1 sigma) below 10 m and +-30 mm beyond, whole millimetres.
SCAN_PERIOD_S = 0.025
FIELD_OF_VIEW_RAD = np.deg2rad(270.0)
BEAMS = 1081
LIGHT_BEAMS = 271
MIN_RANGE_M = 0.1
MAX_RANGE_M = 30.0
NEAR_SIGMA_M = 0.010
FAR_SIGMA_M = 0.030
FAR_M = 10.0
DROPOUT_RATIO = 0.01  # beams whose echo is lost: +inf, as "no return" (REP-117)
ERROR_RATIO = 0.001  # beams that the device flags as wrong: NaN
BRACKET_RATIO = 0.004  # of the beams at either end that hit the spindle's own bracket: -inf, too close
_BRACKET_RANGE_M = 0.06

_STREAM = 103
_POSE_KNOTS = 5  # over one scan; linear between them is exact to 1e-6 rad at 5 rpm
_CULL_SLACK_M = 0.05  # walking within one scan, and the scanner's offset from its axis
_CULL_SLACK_RAD = 0.03  # turning within one scan
_REFLECTIVITY = {"floor": 0.5, "wall": 0.8, "block": 0.6, "debris": 0.4, "valve": 0.3}


@dataclass(frozen=True, slots=True)
class Rays:
    """Beams in the frame `map`: origins_m and unit directions, both (B, 3)."""

    origins_m: FloatArray
    directions: FloatArray


@dataclass(frozen=True, slots=True)
class Scan:
    """One turn of the mirror, beams in order of time.

    ranges_m: (B,) whole millimetres; +inf no return, -inf too close, NaN error (REP-117).
    intensities: (B,) device units, 0 without an echo.
    """

    ranges_m: FloatArray
    intensities: FloatArray


class BoxField:
    """The scene's boxes as arrays, for casting rays."""

    def __init__(self, boxes: Sequence[Box]) -> None:
        self._centres = np.array([box.centre_m for box in boxes])
        self._half_sizes = np.array([box.size_m for box in boxes]) / 2
        self._box_from_map = np.array([box.map_from_box.T for box in boxes])
        self._radii = np.linalg.norm(self._half_sizes, axis=1)
        self._reflectivity = np.array([_REFLECTIVITY[box.kind] for box in boxes])

    def near_plane(self, point_m: FloatArray, normal: FloatArray) -> NDArray[np.intp]:
        """Indices of the boxes that beams close to a plane may touch."""
        offset = self._centres - point_m
        slack = _CULL_SLACK_M + _CULL_SLACK_RAD * np.linalg.norm(offset, axis=1)
        # Slack also for the box's own size: a turn of the plane sweeps its far end.
        slack += _CULL_SLACK_RAD * self._radii
        return np.flatnonzero(np.abs(offset @ normal) <= self._radii + slack)

    def cast(self, rays: Rays, among: NDArray[np.intp] | None = None) -> tuple[FloatArray, FloatArray]:
        """True ranges (B,) in metres, +inf for a miss, and echo strengths (B,) in 0..1. Slab method."""
        chosen = np.arange(len(self._radii)) if among is None else among
        if chosen.size == 0:
            return np.full(len(rays.origins_m), np.inf), np.zeros(len(rays.origins_m))
        # (N, 3, B). One small product per box: a large one wakes the threads of the BLAS, whose
        # waiting cost half as much CPU as the rest of the log.
        turn = self._box_from_map[chosen]
        direction = turn @ np.ascontiguousarray(rays.directions.T)
        offset = np.einsum("nij,nj->ni", turn, self._centres[chosen])
        origin = turn @ np.ascontiguousarray(rays.origins_m.T) - offset[:, :, None]
        # A ray parallel to a slab gets a huge but finite slope: 0 * inf would be NaN.
        direction[np.abs(direction) < 1e-12] = 1e-12
        slope = 1.0 / direction
        middle = np.multiply(origin, slope, out=origin)
        half = np.abs(slope, out=slope)
        half *= self._half_sizes[chosen][:, :, None]
        enter = -middle - half
        near = np.maximum(np.maximum(enter[:, 0], enter[:, 1]), enter[:, 2])
        leave = np.subtract(half, middle, out=half)
        far = np.minimum(np.minimum(leave[:, 0], leave[:, 1]), leave[:, 2])
        ranges = np.where((near <= far) & (near > 0), near, np.inf)
        nearest = np.argmin(ranges, axis=0)
        beam = np.arange(nearest.size)
        true_range = ranges[nearest, beam]
        face = np.argmax(enter[nearest, :, beam], axis=1)
        cosine = np.abs(direction[nearest, face, beam])
        strength = np.where(np.isfinite(true_range), self._reflectivity[chosen][nearest] * cosine, 0.0)
        return true_range, strength


class Scanner:
    """Takes scans of a scene from the walking robot, with the device's noise and codes."""

    def __init__(self, boxes: Sequence[Box], seed: int, beams: int = BEAMS) -> None:
        self._field = BoxField(boxes)
        self._seed = seed
        self._random = np.random.default_rng([seed, _STREAM])
        self.angles_rad = np.linspace(-FIELD_OF_VIEW_RAD / 2, FIELD_OF_VIEW_RAD / 2, beams)
        # The mirror turns once in a period; the beams cover 270 of its 360 degrees.
        self.beam_offsets_s = (self.angles_rad - self.angles_rad[0]) / (2 * np.pi) * SCAN_PERIOD_S
        self._lidar_directions = np.stack(
            [np.cos(self.angles_rad), np.sin(self.angles_rad), np.zeros(beams)], axis=-1
        )

    def rays(self, start_s: float) -> Rays:
        """The beams of the scan that starts at start_s, each from the pose at its own instant."""
        knots = np.linspace(0.0, self.beam_offsets_s[-1], _POSE_KNOTS)
        poses = map_from_lidar(start_s + knots, self._seed)
        place = self.beam_offsets_s / knots[1]
        before = np.minimum(place.astype(np.intp), _POSE_KNOTS - 2)
        ratio = (place - before)[:, None, None]
        pose = poses[before, :3] * (1 - ratio) + poses[before + 1, :3] * ratio
        directions = np.einsum("bij,bj->bi", pose[:, :, :3], self._lidar_directions)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return Rays(pose[:, :, 3], directions)

    def true_ranges(self, start_s: float) -> tuple[FloatArray, FloatArray]:
        """What a perfect device would measure: ranges (B,), +inf for a miss; echo strengths (B,)."""
        rays = self.rays(start_s)
        middle = len(rays.origins_m) // 2
        normal = np.cross(rays.directions[middle // 2], rays.directions[middle + middle // 2])
        among = self._field.near_plane(rays.origins_m[middle], normal / np.linalg.norm(normal))
        return self._field.cast(rays, among)

    def scan(self, start_s: float) -> Scan:
        """One scan with noise, dropouts and REP-117's codes; call in order of time for equal noise."""
        true_range, strength = self.true_ranges(start_s)
        beams = true_range.size
        noise, speckle = self._random.standard_normal((2, beams))
        luck = self._random.random(beams)
        sigma = np.where(true_range < FAR_M, NEAR_SIGMA_M, FAR_SIGMA_M)
        ranges = np.round((true_range + sigma * noise) * 1e3) / 1e3
        ranges[true_range > MAX_RANGE_M] = np.inf
        ranges[luck < DROPOUT_RATIO] = np.inf
        ranges[luck > 1 - ERROR_RATIO] = np.nan
        bracket = round(BRACKET_RATIO * beams)
        ranges[:bracket] = ranges[beams - bracket :] = _BRACKET_RANGE_M
        ranges[ranges < MIN_RANGE_M] = -np.inf
        intensities = np.round(np.clip(3000 * strength + 40 * speckle, 1, 4095))
        intensities[~np.isfinite(ranges)] = 0.0
        return Scan(ranges, intensities)

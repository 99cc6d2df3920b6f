"""The scene: one list of boxes, the truth that lidar, cameras and the judges of maps share."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from straitlink.synthetic.rigid import (
    FloatArray,
    quaternion_from_rotation,
    rotation_about,
    rotation_from_rpy,
)

# Pairs of standard 8x8x16 inch cinder blocks side by side, as in the terrain task of the DRC Trials.
BLOCK_M = (0.39, 0.39, 0.19)
CELL_M = 0.41
CORRIDOR_HALF_WIDTH_M = 0.7
WALL_X_M = 7.6
VALVE_CENTRE_M = (7.38, 0.35, 1.15)
VALVE_RADIUS_M = 0.2
_RIM_SEGMENTS = 16
_STREAM = 101  # of the seed, apart from those of noise and script


@dataclass(frozen=True, slots=True)
class Box:
    """A solid box in the frame `map`.

    kind: "floor", "wall", "block", "debris" or "valve".
    centre_m: (x, y, z). size_m: full edge lengths along the box's own axes.
    map_from_box: (3, 3) rotation.
    """

    kind: str
    centre_m: tuple[float, float, float]
    size_m: tuple[float, float, float]
    map_from_box: FloatArray

    def as_json(self) -> dict[str, object]:
        """The box as the log's ground-truth attachment holds it; quaternion x, y, z, w."""
        return {
            "kind": self.kind,
            "centre_m": list(self.centre_m),
            "size_m": list(self.size_m),
            "orientation_xyzw": quaternion_from_rotation(self.map_from_box).tolist(),
        }


def build_scene(seed: int) -> tuple[Box, ...]:
    """Cinder-block terrain on both sides of a corridor, debris, walls, and a valve at the end."""
    random = np.random.default_rng([seed, _STREAM])
    return (
        _upright("floor", (3.0, 0.0, -0.05), (20.0, 16.0, 0.1)),
        *_walls(),
        *_terrain(random),
        *_debris(random),
        *_valve(),
    )


def _upright(kind: str, centre: tuple[float, float, float], size: tuple[float, float, float]) -> Box:
    return Box(kind, centre, size, np.eye(3))


def _walls() -> Iterator[Box]:
    yield _upright("wall", (WALL_X_M, 0.0, 1.2), (0.2, 8.0, 2.4))
    yield _upright("wall", (4.5, 4.2, 1.0), (5.0, 0.15, 2.0))
    yield _upright("wall", (-3.5, -2.0, 1.2), (0.2, 6.0, 2.4))
    yield _upright("wall", (5.2, -4.0, 1.1), (0.4, 0.4, 2.2))  # a pillar


def _terrain(random: np.random.Generator) -> Iterator[Box]:
    """Stacks of one to three blocks on a grid; the top block of some lies tilted on a wedge."""
    for side in (-1.0, 1.0):
        for column in range(9):
            for row in range(4):
                x = 1.7 + CELL_M * column
                y = side * (CORRIDOR_HALF_WIDTH_M + CELL_M * (row + 0.5))
                # Higher away from the corridor and towards the middle, as a mound is.
                mound = 0.75 * row + 1.2 * np.sin(np.pi * (column + 0.5) / 9) - 0.6
                levels = int(np.clip(np.round(mound + random.normal(0.0, 0.6)), 0, 3))
                if levels > 0:
                    yield from _stack(x, y, levels, random)


def _stack(x: float, y: float, levels: int, random: np.random.Generator) -> Iterator[Box]:
    height = BLOCK_M[2] * (levels - 1)
    if levels > 1:
        yield _upright("block", (x, y, height / 2), (BLOCK_M[0], BLOCK_M[1], height))
    tilt = random.choice([-0.26, 0.0, 0.0, 0.26])  # a DRC wedge is 15 degrees
    roll, pitch = (tilt, 0.0) if random.random() < 0.5 else (0.0, tilt)
    lift = BLOCK_M[2] / 2 + 0.5 * BLOCK_M[0] * abs(np.sin(tilt))
    rotation = rotation_from_rpy(roll, pitch, 0.0)
    yield Box("block", (x, y, height + lift), BLOCK_M, rotation)


def _debris(random: np.random.Generator) -> Iterator[Box]:
    """Beams, planks and rubble between the terrain and the wall, and behind the start."""
    for index in range(30):
        beam = index % 3 == 0
        size = (
            (random.uniform(0.8, 1.6), 0.09, 0.09)
            if beam
            else (random.uniform(0.1, 0.4), random.uniform(0.08, 0.25), random.uniform(0.05, 0.2))
        )
        ahead = index % 5 != 4
        x = random.uniform(5.6, 7.1) if ahead else random.uniform(-3.0, -0.8)
        y = random.uniform(0.8, 3.6) * (1 if random.random() < 0.5 else -1)
        pitch = random.uniform(-0.35, 0.0) if beam else 0.0
        z = size[2] / 2 + 0.5 * size[0] * abs(np.sin(pitch))
        yield Box("debris", (x, y, z), size, rotation_from_rpy(0.0, pitch, random.uniform(-np.pi, np.pi)))


def _valve() -> Iterator[Box]:
    """A wheel of 16 rim segments and three spokes, its axis along x, on a stem and a pipe on the wall."""
    x, y, z = VALVE_CENTRE_M
    chord = 2 * VALVE_RADIUS_M * np.tan(np.pi / _RIM_SEGMENTS)
    for segment in range(_RIM_SEGMENTS):
        angle = 2 * np.pi * segment / _RIM_SEGMENTS
        centre = (x, float(y + VALVE_RADIUS_M * np.cos(angle)), float(z + VALVE_RADIUS_M * np.sin(angle)))
        yield Box("valve", centre, (0.03, 0.03, float(chord)), rotation_about(0, angle))
    for spoke in range(3):
        rotation = rotation_about(0, np.pi * spoke / 3)
        yield Box("valve", VALVE_CENTRE_M, (0.02, 2 * VALVE_RADIUS_M, 0.025), rotation)
    yield _upright("valve", (x + 0.06, y, z), (0.12, 0.05, 0.05))
    yield _upright("valve", (x + 0.14, y, 1.2), (0.09, 0.09, 2.3))

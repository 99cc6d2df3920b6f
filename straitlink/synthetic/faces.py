"""The sides of the scene's boxes as textured rectangles, for drawing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from straitlink.synthetic.rigid import FloatArray
from straitlink.synthetic.scene import Box
from straitlink.synthetic.textures import SIDE_M, TEXELS_PER_M, shade_of

_SUN = np.array([-0.45, 0.35, 0.82]) / np.linalg.norm([-0.45, 0.35, 0.82])
_AMBIENT = 0.45
_STREAM = 105


@dataclass(frozen=True, slots=True)
class Faces:
    """Rectangles of at most SIDE_M, in the frame `map`; arrays with one row per face."""

    corner_m: FloatArray  # (F, 3)
    edge_u_m: FloatArray  # (F, 3)
    edge_v_m: FloatArray  # (F, 3)
    normal: FloatArray  # (F, 3), outwards
    shade: NDArray[np.intp]  # (F,)
    texture_origin: FloatArray  # (F, 2) texels at full resolution
    kinds: tuple[str, ...]


def faces_of(boxes: Sequence[Box], seed: int) -> Faces:
    """The six sides of every box, large ones cut into panels, each with its own piece of texture."""
    random = np.random.default_rng([seed, _STREAM])
    rows: list[tuple[FloatArray, FloatArray, FloatArray, FloatArray]] = []
    kinds: list[str] = []
    for box in boxes:
        tone = random.uniform(0.88, 1.12)
        for axis in range(3):
            for sign in (-1.0, 1.0):
                for panel in _panels(box, axis, sign):
                    rows.append((*panel, np.array([tone])))
                    kinds.append(box.kind)
    corner, edge_u, edge_v = (np.array([row[i] for row in rows]) for i in range(3))
    normal = np.cross(edge_u, edge_v)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    tones = np.array([row[3][0] for row in rows])
    light = tones * (_AMBIENT + (1 - _AMBIENT) * np.clip(normal @ _SUN, 0.0, 1.0))
    lengths = np.stack([np.linalg.norm(edge_u, axis=1), np.linalg.norm(edge_v, axis=1)], axis=1)
    spare = np.maximum(SIDE_M - lengths, 0.0) * TEXELS_PER_M
    origin = spare * random.random(spare.shape)
    shades = np.array([shade_of(value) for value in light], dtype=np.intp)
    return Faces(corner, edge_u, edge_v, normal, shades, origin, tuple(kinds))


def _panels(box: Box, axis: int, sign: float) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """Corner and edges of the panels of one side; edge_u x edge_v points outwards."""
    first, second = ((axis + 1) % 3, (axis + 2) % 3) if sign > 0 else ((axis + 2) % 3, (axis + 1) % 3)
    axes, size = box.map_from_box.T, box.size_m
    start = np.array(box.centre_m) + sign * axes[axis] * size[axis] / 2
    start = start - axes[first] * size[first] / 2 - axes[second] * size[second] / 2
    count_u, count_v = (int(np.ceil(size[a] / SIDE_M - 1e-9)) for a in (first, second))
    edge_u, edge_v = axes[first] * size[first] / count_u, axes[second] * size[second] / count_v
    return [(start + i * edge_u + j * edge_v, edge_u, edge_v) for i in range(count_u) for j in range(count_v)]

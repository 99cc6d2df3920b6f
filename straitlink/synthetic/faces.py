"""The sides of the scene's boxes as textured rectangles, for drawing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from straitlink.synthetic.rigid import FloatArray
from straitlink.synthetic.scene import Box
from straitlink.synthetic.textures import SIDE_M, VARIANTS, shade_of

_SUN = np.array([-0.45, 0.35, 0.82]) / np.linalg.norm([-0.45, 0.35, 0.82])
_AMBIENT = 0.45
_STREAM = 105


@dataclass(frozen=True, slots=True)
class Faces:
    """Rectangles of at most SIDE_M, in the frame `map`; arrays with one row per face, boxes in order."""

    corners_m: FloatArray  # (F, 4, 3): corner, + edge u, + both, + edge v; counter-clockwise from outside
    lengths_m: FloatArray  # (F, 2) of edges u and v
    size_m: tuple[tuple[float, float], ...]  # the same, to the micrometre
    normal: FloatArray  # (F, 3), outwards
    offset_m: FloatArray  # (F,): normal . x on the face
    shade: tuple[int, ...]
    variant: tuple[int, ...]  # which piece of the texture it shows
    kinds: tuple[str, ...]
    box: NDArray[np.intp]  # (F,) which box it belongs to


def faces_of(boxes: Sequence[Box], seed: int) -> Faces:
    """The six sides of every box, large ones cut into panels, each with its own piece of texture."""
    random = np.random.default_rng([seed, _STREAM])
    panels: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    owners: list[int] = []
    for index, box in enumerate(boxes):
        for axis in range(3):
            for sign in (-1.0, 1.0):
                panels += _panels(box, axis, sign)
        owners += [index] * (len(panels) - len(owners))
    box_of = np.array(owners, dtype=np.intp)
    corner, edge_u, edge_v = np.array(panels).transpose(1, 0, 2)
    normal = np.cross(edge_u, edge_v)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    tones = random.uniform(0.88, 1.12, len(boxes))[box_of]
    light = tones * (_AMBIENT + (1 - _AMBIENT) * np.clip(normal @ _SUN, 0.0, 1.0))
    lengths = np.stack([np.linalg.norm(edge_u, axis=1), np.linalg.norm(edge_v, axis=1)], axis=1)
    return Faces(
        corners_m=np.stack([corner, corner + edge_u, corner + edge_u + edge_v, corner + edge_v], axis=1),
        lengths_m=lengths,
        size_m=tuple((u, v) for u, v in np.round(lengths, 6).tolist()),
        normal=normal,
        offset_m=np.einsum("fi,fi->f", normal, corner),
        shade=tuple(shade_of(value) for value in light.tolist()),
        variant=tuple(random.integers(VARIANTS, size=len(owners)).tolist()),
        kinds=tuple(boxes[owner].kind for owner in owners),
        box=box_of,
    )


def _panels(box: Box, axis: int, sign: float) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """Corner and edges of the panels of one side; edge_u x edge_v points outwards."""
    first, second = ((axis + 1) % 3, (axis + 2) % 3) if sign > 0 else ((axis + 2) % 3, (axis + 1) % 3)
    axes, size = box.map_from_box.T, box.size_m
    start = np.array(box.centre_m) + sign * axes[axis] * size[axis] / 2
    start = start - axes[first] * size[first] / 2 - axes[second] * size[second] / 2
    count_u, count_v = (int(np.ceil(size[a] / SIDE_M - 1e-9)) for a in (first, second))
    edge_u, edge_v = axes[first] * size[first] / count_u, axes[second] * size[second] / count_v
    return [(start + i * edge_u + j * edge_v, edge_u, edge_v) for i in range(count_u) for j in range(count_v)]

"""Which of the scene's boxes hides which: the order in which a painter draws them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from straitlink.synthetic.rigid import FloatArray
from straitlink.synthetic.scene import Box

_TOUCH_M = 1e-9  # boxes that touch do not intersect


class Occlusion:
    """Planes between each pair of boxes, found once: a box on the eye's side of one is not hidden.

    Where planes of a pair disagree, neither box hides the other. Boxes that intersect have no plane
    between them; theirs is the one that they cross least, and the nearer is drawn whole.
    """

    def __init__(self, boxes: Sequence[Box]) -> None:
        self._centres_m = np.array([box.centre_m for box in boxes])
        half_m = np.array([box.size_m for box in boxes]) / 2
        axes = np.array([box.map_from_box.T for box in boxes])  # (N, 3, 3): a row per axis
        self._pairs = first, second = np.triu_indices(len(boxes), 1)
        self._normals, self._offsets_m = _planes(
            (self._centres_m[first], axes[first], half_m[first]),
            (self._centres_m[second], axes[second], half_m[second]),
        )

    def far_to_near(
        self, eye_m: FloatArray, shown: NDArray[np.intp], windows: NDArray[np.intp]
    ) -> NDArray[np.intp]:
        """The boxes `shown`, each before those that hide a part of it.

        eye_m: (3,) in `map`. windows: (M, 4) left, top, right, bottom of each of them in the image.
        Of boxes in a ring, each in front of the next, the farthest is drawn first.
        """
        hides = self._hides(eye_m)[np.ix_(shown, shown)]
        left, top, right, bottom = windows.T
        apart = (left[:, None] > right) | (top[:, None] > bottom)
        hides &= ~(apart | apart.T)
        behind = hides.sum(axis=1)  # of those that a box hides, how many are still to be drawn
        distance_m = np.linalg.norm(self._centres_m[shown] - eye_m, axis=1)
        waiting = np.ones(shown.size, dtype=bool)
        order: list[NDArray[np.intp]] = []
        while waiting.any():
            ready = np.flatnonzero(waiting & (behind == 0))
            if ready.size == 0:
                ready = np.array([np.argmax(np.where(waiting, distance_m, -1.0))])
            waiting[ready] = False
            behind -= hides[:, ready].sum(axis=1)
            order.append(ready)
        return shown[np.concatenate(order)]

    def _hides(self, eye_m: FloatArray) -> NDArray[np.bool_]:
        """(N, N): whether the box of the row may hide a part of the box of the column."""
        first_side = self._normals @ eye_m > self._offsets_m  # (planes, pairs)
        hides = np.zeros((len(self._centres_m), len(self._centres_m)), dtype=bool)
        hides[self._pairs] = first_side.all(axis=0)
        hides.T[self._pairs] = ~first_side.any(axis=0)
        return hides


def _planes(
    first: tuple[FloatArray, FloatArray, FloatArray], second: tuple[FloatArray, FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Normals (7, P, 3) and offsets (7, P) of planes with each pair's first box on the positive side.

    first, second: centres (P, 3), axes (P, 3, 3) and half sizes (P, 3) of the pairs' boxes.
    The six planes along faces and the best of all, which also stands where a face does not separate.
    Source: Gottschalk, Lin and Manocha, SIGGRAPH 1996, for the 15 candidates.
    """
    centres, axes, half_m = first
    other_centres, other_axes, other_half_m = second
    edges = np.cross(axes[:, :, None], other_axes[:, None, :]).reshape(-1, 9, 3)
    candidates = np.concatenate([axes, other_axes, edges], axis=1)  # (P, 15, 3)
    length = np.linalg.norm(candidates, axis=2, keepdims=True)
    candidates /= np.maximum(length, 1e-6)
    apart = np.einsum("pai,pi->pa", candidates, centres - other_centres)
    candidates *= np.where(apart < 0, -1.0, 1.0)[:, :, None]
    reach = _reach(candidates, axes, half_m)
    gap = np.abs(apart) - reach - _reach(candidates, other_axes, other_half_m)
    gap[length[:, :, 0] < 1e-6] = -np.inf  # parallel edges
    offset = np.einsum("pai,pi->pa", candidates, centres) - reach - gap / 2
    best = np.argmax(gap, axis=1)[:, None]
    faces = np.arange(7)
    chosen = np.where((faces < 6) & (gap[:, :7] > -_TOUCH_M), faces, best)
    normals = np.take_along_axis(candidates, chosen[:, :, None], axis=1)
    return np.ascontiguousarray(normals.transpose(1, 0, 2)), np.take_along_axis(offset, chosen, axis=1).T


def _reach(candidates: FloatArray, axes: FloatArray, half_m: FloatArray) -> FloatArray:
    """(P, 15): how far each box reaches from its centre along each candidate."""
    reach: FloatArray = (np.abs(np.einsum("pai,pji->paj", candidates, axes)) * half_m[:, None, :]).sum(axis=2)
    return reach

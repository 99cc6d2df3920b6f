"""The cameras: the scene's boxes drawn with textures and an exact depth buffer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from straitlink.synthetic.faces import faces_of
from straitlink.synthetic.rigid import FloatArray, inverse
from straitlink.synthetic.scene import Box
from straitlink.synthetic.settings import Texture
from straitlink.synthetic.textures import (
    LOOKS,
    TEXELS_PER_M,
    Image,
    levels_of,
    mean_colour,
    shaded,
)

_NEAR_M = 0.05
_STREAM = 105
_NOISE_MARGIN_PIXELS = 64
_SUBPIXEL_BITS = 4
_FLAT_PIXELS = 64  # a patch as small as this has one colour: no texture to see, and half of the time
_SUBPIXELS = 1 << _SUBPIXEL_BITS


@dataclass(frozen=True, slots=True)
class Pinhole:
    """A camera without distortion: size in pixels, focal length in pixels, optical axis in the middle."""

    width: int
    height: int
    focal_pixels: float

    @property
    def matrix(self) -> FloatArray:
        """K, (3, 3); pixel centres are at whole numbers."""
        centre_x, centre_y = (self.width - 1) / 2, (self.height - 1) / 2
        focal = self.focal_pixels
        return np.array([[focal, 0.0, centre_x], [0.0, focal, centre_y], [0.0, 0.0, 1.0]])


class _View(NamedTuple):
    """One visible face as the camera sees it (a tuple: thousands are made each second)."""

    face: int
    outline: FloatArray  # (corners, 2) pixels
    window: Sequence[int]  # left, top, right, bottom in pixels
    plane: Sequence[float]  # slope_x, slope_y, offset: 1 / depth is linear in the image
    nearest: float  # the largest 1 / depth
    texel_from_pixel: FloatArray  # (3, 3) homography
    level: int


class Renderer:
    """Draws a scene for one pinhole camera; owns its buffers, so each frame is overwritten by the next."""

    def __init__(self, boxes: Sequence[Box], camera: Pinhole, texture: Texture, seed: int) -> None:
        self.camera = camera
        self._texture: Texture = texture
        self._seed = seed
        self._faces = faces_of(boxes, seed)
        shape = (camera.height, camera.width)
        self._frame: Image = np.zeros((*shape, 3), np.uint8)
        self._inverse_depth = np.zeros(shape, np.float32)
        self._columns = np.arange(camera.width, dtype=np.float32)
        self._rows = np.arange(camera.height, dtype=np.float32)[:, None]
        self._sky = _sky(camera)
        self._random = np.random.default_rng([seed, _STREAM, camera.width])
        margin = _NOISE_MARGIN_PIXELS
        grain = self._random.normal(0, LOOKS[texture].noise, (shape[0] + margin, shape[1] + margin, 3))
        self._noise = np.round(grain).astype(np.int16)

    def draw(self, map_from_optical: FloatArray) -> Image:
        """A (height, width, 3) BGR frame; valid until the next call."""
        optical_from_map = inverse(map_from_optical)
        self._frame[:] = self._sky
        self._inverse_depth[:] = 0.0
        faces = self._faces
        turn, shift = optical_from_map[:3, :3], optical_from_map[:3, 3]
        corner = faces.corner_m @ turn.T + shift
        edge_u, edge_v = faces.edge_u_m @ turn.T, faces.edge_v_m @ turn.T
        normal = faces.normal @ turn.T
        distance = np.einsum("fi,fi->f", corner, normal)
        corners = np.stack([corner, corner + edge_u, corner + edge_u + edge_v, corner + edge_v], axis=1)
        order = self._visible(corners, distance)
        planes = normal[order] / distance[order, None]
        views = self._views(order, corners[order], edge_u[order], edge_v[order], planes)
        for view in views:
            self._draw_face(view)
        return self._frame

    def expose(self, map_from_optical: FloatArray) -> Image:
        """`draw`, with the sensor's noise on top."""
        frame = self.draw(map_from_optical)
        row, column = self._random.integers(0, _NOISE_MARGIN_PIXELS, 2)
        height, width = frame.shape[:2]
        noise = self._noise[row : row + height, column : column + width]
        noisy: Image = cv2.add(frame, noise, dtype=cv2.CV_8U)
        return noisy

    def depth_m(self) -> NDArray[np.float32]:
        """Depth along the optical axis of the last frame drawn; +inf where there is sky."""
        with np.errstate(divide="ignore"):
            depth: NDArray[np.float32] = np.float32(1.0) / self._inverse_depth
        return depth

    def _visible(self, corners: FloatArray, distance: FloatArray) -> NDArray[np.intp]:
        """Faces that look at the camera and touch its frustum, nearest first."""
        depth = corners[:, :, 2]
        reach_x = (self.camera.width / 2) / self.camera.focal_pixels
        reach_y = (self.camera.height / 2) / self.camera.focal_pixels
        x, y = corners[:, :, 0], corners[:, :, 1]
        outside = (
            (depth <= _NEAR_M).all(axis=1)
            | (x < -reach_x * depth).all(axis=1)
            | (x > reach_x * depth).all(axis=1)
            | (y < -reach_y * depth).all(axis=1)
            | (y > reach_y * depth).all(axis=1)
        )
        seen = np.flatnonzero((distance < -1e-6) & ~outside)
        return seen[np.argsort(depth[seen].mean(axis=1), kind="stable")]

    def _views(
        self,
        order: NDArray[np.intp],
        corners: FloatArray,
        edge_u: FloatArray,
        edge_v: FloatArray,
        planes: FloatArray,
    ) -> list[_View]:
        """What drawing needs to know of each visible face; all faces at once, for speed.

        planes: normal / distance in the optical frame, so that plane . ray = 1 / depth.
        """
        camera = self.camera
        depth = np.maximum(corners[:, :, 2], _NEAR_M)
        outlines: list[FloatArray] = list(self._project(corners, depth))
        for index in np.flatnonzero(corners[:, :, 2].min(axis=1) < _NEAR_M):
            polygon = _clip_near(corners[index])
            outlines[index] = self._project(polygon, polygon[:, 2])
        low = np.maximum([outline.min(axis=0) for outline in outlines], 0).astype(int)
        high = np.array([outline.max(axis=0) for outline in outlines]).astype(int) + 2
        high = np.minimum(high, (camera.width, camera.height))
        slopes = planes[:, :2] / camera.focal_pixels
        offsets = planes[:, 2] - slopes @ camera.matrix[:2, 2]
        level = levels_of(camera.focal_pixels / depth.mean(axis=1))
        warps = self._warps(order, corners[:, 0], edge_u, edge_v, level)
        rows = zip(
            order.tolist(),
            outlines,
            np.concatenate([low, high], axis=1).tolist(),
            np.column_stack([slopes, offsets]).tolist(),
            (1.0 / depth.min(axis=1)).tolist(),
            warps,
            level.tolist(),
            strict=True,
        )
        return [_View(*row) for row in rows]

    def _project(self, points: FloatArray, depth: FloatArray) -> FloatArray:
        """(..., 2) pixels of (..., 3) points in the optical frame."""
        middle = self.camera.matrix[:2, 2]
        pixels: FloatArray = points[..., :2] / depth[..., None] * self.camera.focal_pixels + middle
        return pixels

    def _warps(
        self,
        order: NDArray[np.intp],
        corner: FloatArray,
        edge_u: FloatArray,
        edge_v: FloatArray,
        level: NDArray[np.intp],
    ) -> FloatArray:
        """(V, 3, 3) texel_from_pixel homographies."""
        scale = 0.5**level
        # Texel -> metres along the edges -> optical frame -> pixel; the warp wants the inverse.
        along = np.stack([_unit(edge_u), _unit(edge_v), corner], axis=2)
        texel_from_metres = np.zeros((order.size, 3, 3))
        texel_from_metres[:, 0, 0] = texel_from_metres[:, 1, 1] = TEXELS_PER_M * scale
        texel_from_metres[:, :2, 2] = self._faces.texture_origin[order] * scale[:, None]
        texel_from_metres[:, 2, 2] = 1.0
        homographies: FloatArray = texel_from_metres @ np.linalg.inv(self.camera.matrix @ along)
        return homographies

    def _draw_face(self, view: _View) -> None:
        """Where the face is nearer than what is drawn already, draw it."""
        left, top, right, bottom = view.window
        if right <= left or bottom <= top:
            return
        window = (slice(top, bottom), slice(left, right))
        drawn = self._inverse_depth[window]
        if drawn.min() >= view.nearest:
            return  # all of it hidden
        mask = np.zeros(drawn.shape, np.uint8)
        outline = np.rint((view.outline - (left, top)) * _SUBPIXELS).astype(np.int32)
        cv2.fillConvexPoly(mask, outline, 1, shift=_SUBPIXEL_BITS)
        slope_x, slope_y, offset = view.plane
        nearness = np.float32(slope_x) * self._columns[left:right] + (
            np.float32(slope_y) * self._rows[top:bottom] + np.float32(offset)
        )
        visible = nearness > drawn
        visible &= mask.view(np.bool_)
        x, y, width, height = cv2.boundingRect(visible.view(np.uint8))
        if width == 0:
            return
        np.copyto(drawn, nearness, where=visible)
        self._paint(view, (left + x, top + y), visible[y : y + height, x : x + width])

    def _paint(self, view: _View, origin: tuple[int, int], visible: NDArray[np.bool_]) -> None:
        """Put the face's texture where it is visible; origin: (left, top) of that window in the frame."""
        left, top = origin
        height, width = visible.shape
        warp = view.texel_from_pixel
        warp[:, 2] += warp[:, 0] * left + warp[:, 1] * top
        kind, shade = self._faces.kinds[view.face], int(self._faces.shade[view.face])
        target = self._frame[top : top + height, left : left + width]
        if visible.size <= _FLAT_PIXELS:
            target[visible] = mean_colour(kind, self._texture, self._seed, shade)
            return
        image = cv2.warpPerspective(
            shaded(kind, self._texture, self._seed, view.level, shade),
            warp,
            (width, height),
            flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,  # a seventh of the time of INTER_LINEAR
            borderMode=cv2.BORDER_REPLICATE,
        )
        cv2.copyTo(image, visible.view(np.uint8), target)


def _unit(vectors: FloatArray) -> FloatArray:
    unit: FloatArray = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return unit


def _clip_near(corners: FloatArray) -> FloatArray:
    """A polygon cut at the near plane (Sutherland and Hodgman 1974)."""
    kept: list[FloatArray] = []
    for here, there in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        if here[2] >= _NEAR_M:
            kept.append(here)
        if (here[2] >= _NEAR_M) != (there[2] >= _NEAR_M):
            kept.append(here + (there - here) * (_NEAR_M - here[2]) / (there[2] - here[2]))
    return np.array(kept)


def _sky(camera: Pinhole) -> Image:
    ratio = np.linspace(0.0, 1.0, camera.height)[:, None, None]
    colour = (1 - ratio) * np.array([205, 175, 150]) + ratio * np.array([225, 218, 210])
    sky: Image = np.broadcast_to(colour, (camera.height, camera.width, 3)).astype(np.uint8)
    return sky

"""The cameras: the scene's boxes painted with textures, what is far first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from straitlink.synthetic.faces import faces_of
from straitlink.synthetic.occlusion import Occlusion
from straitlink.synthetic.rigid import FloatArray, inverse
from straitlink.synthetic.scene import Box
from straitlink.synthetic.settings import Texture
from straitlink.synthetic.textures import LOOKS, TEXELS_PER_M, Image, levels_of, mean_colour, piece

_NEAR_M = 0.05
_STREAM = 105
_NOISE_MARGIN_PIXELS = 64
_SUBPIXEL_BITS = 4
_COARSE_BITS = 2  # what is hidden is found on an image of a quarter of the width and height
_FLAT_COARSE_PIXELS = 6  # a face that shows as little as this has one colour: no texture to see
_SMALL_WINDOW_PIXELS = 2048  # drawn whole: looking for the part that shows would take longer


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
    """One face as the camera sees it (a tuple: thousands are made each second)."""

    face: int
    outline: NDArray[np.int32]  # (corners, 2) in 1/16 pixels
    cut: bool  # a part of it is behind the camera
    window: Sequence[int]  # left, top, right, bottom in pixels
    texel_from_pixel: FloatArray  # (3, 3) homography
    level: int


class Renderer:
    """Draws a scene for one pinhole camera; owns its buffers, so each frame is overwritten by the next."""

    def __init__(self, boxes: Sequence[Box], camera: Pinhole, texture: Texture, seed: int) -> None:
        self.camera = camera
        self._texture: Texture = texture
        self._seed = seed
        self._faces = faces_of(boxes, seed)
        self._colours = [
            mean_colour(kind, texture, seed, shade)
            for kind, shade in zip(self._faces.kinds, self._faces.shade, strict=True)
        ]
        self._pieces: dict[tuple[int, int], Image] = {}
        self._occlusion = Occlusion(boxes)
        shape = (camera.height, camera.width)
        self._frame: Image = np.zeros((*shape, 3), np.uint8)
        self._coarse = np.zeros([(side >> _COARSE_BITS) + 1 for side in shape], np.int32)
        self._sky = _sky(camera)
        self._views: list[_View] = []
        self._planes: FloatArray = np.zeros((0, 3))
        self._random = np.random.default_rng([seed, _STREAM, camera.width])
        margin = _NOISE_MARGIN_PIXELS
        grain = self._random.normal(0, LOOKS[texture].noise, (shape[0] + margin, shape[1] + margin, 3))
        # In two parts because OpenCV adds bytes to bytes ten times as fast as words to bytes.
        grain = np.round(grain)
        self._brighter = np.clip(grain, 0, 255).astype(np.uint8)
        self._darker = np.clip(-grain, 0, 255).astype(np.uint8)

    def draw(self, map_from_optical: FloatArray) -> Image:
        """A (height, width, 3) BGR frame; valid until the next call."""
        optical_from_map = inverse(map_from_optical)
        turn, shift = optical_from_map[:3, :3], optical_from_map[:3, 3]
        faces, eye_m = self._faces, map_from_optical[:3, 3]
        corners = (faces.corners_m.reshape(-1, 3) @ turn.T + shift).reshape(faces.corners_m.shape)
        distance = faces.offset_m - faces.normal @ eye_m  # negative: the camera sees its outside
        shown = self._in_view(corners, distance)
        self._planes = (faces.normal @ turn.T) / np.where(distance == 0.0, 1.0, distance)[:, None]
        self._views = self._far_to_near(shown, corners[shown], eye_m)
        self._frame[:] = self._sky
        visible = self._visible_coarse_pixels()
        for number, (view, pixels) in enumerate(zip(self._views, visible, strict=True), start=1):
            cv2.fillConvexPoly(self._frame, view.outline, self._colours[view.face], shift=_SUBPIXEL_BITS)
            if pixels > _FLAT_COARSE_PIXELS:
                self._put_texture(view, self._part_that_shows(number, view))
        return self._frame

    def expose(self, map_from_optical: FloatArray) -> Image:
        """`draw`, with the sensor's noise on top."""
        frame = self.draw(map_from_optical)
        row, column = self._random.integers(0, _NOISE_MARGIN_PIXELS, 2)
        height, width = frame.shape[:2]
        window = (slice(row, row + height), slice(column, column + width))
        noisy: Image = cv2.subtract(cv2.add(frame, self._brighter[window]), self._darker[window])
        return noisy

    def depth_m(self) -> NDArray[np.float64]:
        """Depth along the optical axis of the last frame drawn, (height, width); +inf where there is sky."""
        camera = self.camera
        nearest = np.full((camera.height, camera.width), -1, np.int32)
        for view in self._views:
            cv2.fillConvexPoly(nearest, view.outline, view.face, shift=_SUBPIXEL_BITS)
        rows, columns = np.nonzero(nearest >= 0)
        rays = np.stack([columns, rows, np.ones(rows.size)], axis=1) @ np.linalg.inv(camera.matrix).T
        depth = np.full(nearest.shape, np.inf)
        # A plane is normal / distance in the optical frame, so that plane . ray = 1 / depth.
        depth[rows, columns] = 1.0 / np.einsum("pi,pi->p", self._planes[nearest[rows, columns]], rays)
        return depth

    def _in_view(self, corners: FloatArray, distance: FloatArray) -> NDArray[np.intp]:
        """Faces that look at the camera and touch its frustum."""
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
        return np.flatnonzero((distance < -1e-6) & ~outside)

    def _far_to_near(self, shown: NDArray[np.intp], corners: FloatArray, eye_m: FloatArray) -> list[_View]:
        """What drawing needs to know of each face; all faces at once, for speed.

        corners: (V, 4, 3) of the faces `shown`, in the optical frame.
        """
        if shown.size == 0:
            return []
        depth = np.maximum(corners[:, :, 2], _NEAR_M)
        pixels = self._project(corners, depth)
        low, high = pixels.min(axis=1), pixels.max(axis=1)
        outlines = list(np.rint(pixels * (1 << _SUBPIXEL_BITS)).astype(np.int32))
        cut = corners[:, :, 2].min(axis=1) < _NEAR_M
        for index in np.flatnonzero(cut):
            polygon = _clip_near(corners[index])
            outline = self._project(polygon, polygon[:, 2])
            low[index], high[index] = outline.min(axis=0), outline.max(axis=0)
            outlines[index] = np.rint(outline * (1 << _SUBPIXEL_BITS)).astype(np.int32)
        size = (self.camera.width, self.camera.height)
        windows = np.concatenate(
            [np.maximum(low, 0).astype(int), np.minimum(high, size).astype(int) + 1], axis=1
        )
        windows[:, 2:] = np.minimum(windows[:, 2:], size)
        level = levels_of(self.camera.focal_pixels / depth.mean(axis=1))
        warps = self._warps(corners, self._faces.lengths_m[shown], level)
        rows = (shown.tolist(), outlines, cut.tolist(), windows.tolist(), warps, level.tolist())
        views = [_View(*row) for row in zip(*rows, strict=True)]
        return [views[index] for index in self._order(shown, windows, eye_m)]

    def _order(self, shown: NDArray[np.intp], windows: NDArray[np.intp], eye_m: FloatArray) -> list[int]:
        """Places in `shown`, far to near; the faces that one box shows do not hide each other."""
        box = self._faces.box[shown]
        first = np.flatnonzero(np.diff(box, prepend=-1))
        around = np.concatenate(
            [np.minimum.reduceat(windows[:, :2], first), np.maximum.reduceat(windows[:, 2:], first)], axis=1
        )
        rank = np.empty(self._faces.box[-1] + 1, dtype=np.intp)
        ordered = self._occlusion.far_to_near(eye_m, box[first], around)
        rank[ordered] = np.arange(ordered.size)
        order: list[int] = np.argsort(rank[box], kind="stable").tolist()
        return order

    def _project(self, points: FloatArray, depth: FloatArray) -> FloatArray:
        """(..., 2) pixels of (..., 3) points in the optical frame."""
        middle = self.camera.matrix[:2, 2]
        pixels: FloatArray = points[..., :2] / depth[..., None] * self.camera.focal_pixels + middle
        return pixels

    def _warps(
        self,
        corners: FloatArray,
        lengths_m: FloatArray,
        level: NDArray[np.intp],
    ) -> FloatArray:
        """(V, 3, 3) texel_from_pixel homographies, to a face's own piece of texture."""
        corner = corners[:, 0]
        edge_u = (corners[:, 1] - corner) / lengths_m[:, :1]
        edge_v = (corners[:, 3] - corner) / lengths_m[:, 1:]
        pixel_from_metres = self.camera.matrix @ np.stack([edge_u, edge_v, corner], axis=2)
        warps: FloatArray = np.asarray(np.linalg.inv(pixel_from_metres), dtype=np.float64)
        warps[:, :2] *= (TEXELS_PER_M * 0.5**level)[:, None, None]
        warps[:, :2] -= 0.5 * warps[:, 2:]  # texel i covers [i, i + 1), and the warp rounds
        return warps

    def _visible_coarse_pixels(self) -> list[int]:
        """Of each view, how many pixels of a coarse image are its own when all are painted."""
        self._coarse[:] = 0
        for number, view in enumerate(self._views, start=1):
            cv2.fillConvexPoly(self._coarse, view.outline, number, shift=_SUBPIXEL_BITS + _COARSE_BITS)
        counts: list[int] = np.bincount(self._coarse.ravel(), minlength=len(self._views) + 1).tolist()
        return counts[1:]

    def _part_that_shows(self, number: int, view: _View) -> Sequence[int]:
        """The view's window less what other faces hide of it; left, top, right, bottom."""
        left, top, right, bottom = view.window
        if (right - left) * (bottom - top) < _SMALL_WINDOW_PIXELS:
            return view.window
        across, down = left >> _COARSE_BITS, top >> _COARSE_BITS
        coarse = self._coarse[down : (bottom >> _COARSE_BITS) + 1, across : (right >> _COARSE_BITS) + 1]
        x, y, width, height = cv2.boundingRect((coarse == number).view(np.uint8))
        # One coarse pixel more on each side: it stands for the middle of its sixteen.
        return (
            max(left, (across + x - 1) << _COARSE_BITS),
            max(top, (down + y - 1) << _COARSE_BITS),
            min(right, (across + x + width + 1) << _COARSE_BITS),
            min(bottom, (down + y + height + 1) << _COARSE_BITS),
        )

    def _piece(self, face: int, level: int) -> Image:
        found = self._pieces.get((face, level))
        if found is None:
            faces = self._faces
            look = (faces.kinds[face], self._texture, self._seed, level, faces.shade[face])
            found = self._pieces[face, level] = piece(*look, faces.size_m[face], faces.variant[face])
        return found

    def _put_texture(self, view: _View, window: Sequence[int]) -> None:
        """Warp the face's piece of texture into a window of the frame."""
        texture = self._piece(view.face, view.level)
        if texture.size == 0:
            return
        left, top, right, bottom = window
        target = self._frame[top:bottom, left:right]
        warp = view.texel_from_pixel
        warp[:, 2] += warp[:, 0] * left + warp[:, 1] * top
        size = (right - left, bottom - top)
        flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP  # a quarter of the time of INTER_LINEAR
        if not view.cut:
            # Pixels whose texel is off the texture are outside of the outline, and stay as they are.
            cv2.warpPerspective(texture, warp, size, target, flags, borderMode=cv2.BORDER_TRANSPARENT)
            return
        # What is behind the camera would show in the sky: only the outline is drawn.
        image = cv2.warpPerspective(texture, warp, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        mask = np.zeros(image.shape[:2], np.uint8)
        offset = np.array([left, top], np.int32) << _SUBPIXEL_BITS
        cv2.fillConvexPoly(mask, view.outline - offset, 1, shift=_SUBPIXEL_BITS)
        cv2.copyTo(image, mask, target)


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
    sky: Image = np.broadcast_to(colour, (camera.height, camera.width, 3)).astype(np.uint8, order="C")
    return sky

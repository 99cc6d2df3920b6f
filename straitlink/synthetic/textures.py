"""Surface textures as pyramids: what makes a camera frame cost its bytes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from straitlink.synthetic.settings import Texture

Image = NDArray[np.uint8]

TEXELS_PER_M = 384  # more than the head camera resolves 1.6 m away, nearer than which it hardly comes
SIDE_M = 2.0  # of the square that a texture covers
VARIANTS = 4  # pieces that a small face may show of it: few enough to stay in the processor's cache
_SIDE = int(TEXELS_PER_M * SIDE_M)
_LEVELS = 7
_SHADES = 8
_STREAM = 104


@dataclass(frozen=True, slots=True)
class Look:
    """How one preset of textures looks.

    grain: standard deviation of the finest grain, in grey levels. mottle: of the coarse one.
    noise: of the image sensor.
    """

    grain: float
    mottle: float
    noise: float


# Tuned at JPEG quality 85 to the bytes per pixel of real recordings: KITTI outdoors 0.265, a
# humanoid's head camera indoors 0.115.
LOOKS: dict[Texture, Look] = {
    "busy": Look(grain=13.0, mottle=14.0, noise=2.0),
    "indoor": Look(grain=2.5, mottle=4.0, noise=0.6),
}
_COLOURS_BGR = {
    "floor": (128, 132, 135),
    "wall": (150, 165, 172),
    "block": (140, 146, 150),
    "debris": (70, 105, 145),
    "valve": (40, 40, 190),
}


@lru_cache(maxsize=16)
def texture_pyramid(kind: str, preset: Texture, seed: int) -> tuple[Image, ...]:
    """Square BGR images of SIDE_M metres, each half the size of the one before."""
    look = LOOKS[preset]
    random = np.random.default_rng([seed, _STREAM, sum(kind.encode())])
    grey = look.grain * random.standard_normal((_SIDE, _SIDE), dtype=np.float32)
    for cells, weight in ((_SIDE // 4, 0.8), (_SIDE // 32, 1.0), (8, 0.7)):
        coarse = random.standard_normal((cells, cells), dtype=np.float32)
        grey += look.mottle * weight * cv2.resize(coarse, (_SIDE, _SIDE), interpolation=cv2.INTER_LINEAR)
    if kind == "debris":  # the grain of wood runs along the beam
        grey = cv2.blur(grey, (33, 1)) * 2.0
    if kind in ("floor", "wall"):
        grey[:3] = grey[:, :3] = -60.0  # joints between slabs and panels
    colour = np.array(_COLOURS_BGR[kind], dtype=np.float32)
    base: Image = np.clip(colour + grey[:, :, None], 0, 255).astype(np.uint8)
    levels = [base]
    for _ in range(_LEVELS - 1):
        size = levels[-1].shape[0] // 2
        levels.append(cv2.resize(levels[-1], (size, size), interpolation=cv2.INTER_AREA))
    return tuple(levels)


@lru_cache(maxsize=4096)
def piece(
    kind: str,
    preset: Texture,
    seed: int,
    level: int,
    shade: int,
    size_m: tuple[float, float],
    variant: int,
) -> Image:
    """What a face of size_m (along u, v; at most SIDE_M) shows of a texture under one of the lights.

    shade: as `shade_of` says. variant: 0..VARIANTS-1.
    Has no texels where the face is narrower than one.
    """
    image = texture_pyramid(kind, preset, seed)[level]
    texels_per_m = TEXELS_PER_M * 0.5**level
    columns, rows = (int(side_m * texels_per_m + 1e-6) for side_m in size_m)
    left = (image.shape[1] - columns) * variant // VARIANTS
    top = (image.shape[0] - rows) * variant // VARIANTS
    return _lit(image[top : top + rows, left : left + columns], shade)


@lru_cache(maxsize=128)
def mean_colour(kind: str, preset: Texture, seed: int, shade: int) -> tuple[int, int, int]:
    """BGR: what is left of a texture from far away."""
    smallest = texture_pyramid(kind, preset, seed)[-1]
    blue, green, red = _lit(smallest, shade).mean(axis=(0, 1)).astype(int).tolist()
    return blue, green, red


def _lit(image: Image, shade: int) -> Image:
    if image.size == 0:
        return image
    lit: Image = cv2.convertScaleAbs(image, alpha=shade / _SHADES)
    return lit


def shade_of(light_ratio: float) -> int:
    """The nearest of the lights for a brightness in 0..1.25."""
    return round(min(max(light_ratio, 0.0), 1.25) * _SHADES)


def levels_of(pixels_per_m: NDArray[np.float64]) -> NDArray[np.intp]:
    """(N,) levels whose texels come close to pixels without being much finer."""
    ratio = np.maximum(TEXELS_PER_M / pixels_per_m, 1.0)
    levels: NDArray[np.intp] = np.clip(np.floor(np.log2(ratio) + 0.3), 0, _LEVELS - 1).astype(np.intp)
    return levels

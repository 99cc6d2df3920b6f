"""What a viewpoint would see: the nearest surface per pixel, holes where nothing answers.

The nearest return alone would be biased towards the viewer by the noise of many; so a pixel's value is the
mean of the returns within NEAR_M behind its nearest one. Where a near surface was not hit, returns from
what it hides would show through: a pixel of few returns that lies behind most of its neighbours stays a
hole. Noise carries returns of an edge into the pixels beside it: where few of a pixel's returns are near
ones, and a neighbour has many of that surface, the two contradict each other, and it stays a hole too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from perception_server.compiled import compiled
from perception_server.frames import FloatArray

NEAR_M = 0.06  # thickness of a surface as a scanner sees it: +-3 sigma
BEHIND_RATIO = 0.03  # a pixel is behind its neighbour if farther by this share of the range
STRAY_SHARE = 0.25  # of a pixel's returns and of a neighbour's: so few are noise of what stands there
FEW = 3  # returns that may have come through a gap


@dataclass(frozen=True, slots=True)
class Projection:
    """How pixels look out of the view's origin: x forward, y left, z up; row 0 on top, column 0 on the left.

    Perspective: values are depths along x, pixels equal steps of the tangents. Spherical: values are
    distances, pixels equal steps of azimuth and elevation.
    """

    spherical: bool
    columns: int
    rows: int
    horizontal_fov_rad: float
    vertical_fov_rad: float

    @property
    def extent(self) -> tuple[float, float]:
        """Half the field of view, across and up: tangents, or radians if spherical."""
        across, up = self.horizontal_fov_rad / 2, self.vertical_fov_rad / 2
        return (across, up) if self.spherical else (float(np.tan(across)), float(np.tan(up)))

    def rays(self) -> FloatArray:
        """(rows, columns, 3): times a pixel's value, the point that it shows, in the view's frame."""
        across, up = self.extent
        y = across * (1 - 2 * (np.arange(self.columns) + 0.5) / self.columns)
        z = up * (1 - 2 * (np.arange(self.rows) + 0.5) / self.rows)
        y, z = np.meshgrid(y, z)
        if not self.spherical:
            return np.stack([np.ones_like(y), y, z], axis=-1)
        return np.stack([np.cos(z) * np.cos(y), np.cos(z) * np.sin(y), np.sin(z)], axis=-1)

    def planes(self) -> FloatArray:
        """(P, 4): half-planes (n . p + d >= 0) outside which no pixel looks, to pass over points by.

        Of a spherical map its azimuths alone: elevations bound cones.
        """
        across, up = self.horizontal_fov_rad / 2, self.vertical_fov_rad / 2
        if across > np.pi / 2:
            return np.zeros((0, 4))
        sides = [[np.sin(across), side * np.cos(across), 0.0, 0.0] for side in (-1.0, 1.0)]
        if not self.spherical:
            sides += [[np.sin(up), 0.0, side * np.cos(up), 0.0] for side in (-1.0, 1.0)]
        return np.array(sides)


def render_range_map(points_m: NDArray[np.float32], projection: Projection) -> NDArray[np.float32]:
    """(rows, columns) metres, NaN for holes. points_m: (N, 3) in the view's frame, any."""
    across, up = projection.extent
    columns, rows = projection.columns, projection.rows
    pixels = np.empty(len(points_m), dtype=np.int32)
    values = np.empty(len(points_m), dtype=np.float32)
    nearest = _project(points_m, projection.spherical, across, up, columns, rows, pixels, values)
    surface = _surface(pixels, values, nearest)
    return _seen(surface, columns, rows)


@compiled
def _project(
    points: NDArray[np.float32],
    spherical: bool,
    across: float,
    up: float,
    columns: int,
    rows: int,
    pixels: NDArray[np.int32],
    values: NDArray[np.float32],
) -> NDArray[np.float32]:
    """(pixels,) nearest value of each; fills each point's pixel, -1 = outside, and value."""
    nearest = np.full(rows * columns, np.float32(np.inf), dtype=np.float32)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        pixels[i] = -1
        if spherical:
            value = np.sqrt(x * x + y * y + z * z)
            if value < 1e-3:
                continue
            u, v = np.arctan2(y, x) / across, np.arcsin(z / value) / up
        else:
            value = x
            if value < 1e-3:
                continue
            u, v = y / (x * across), z / (x * up)
        column = (1 - u) * columns / 2
        row = (1 - v) * rows / 2
        if not (0 <= column < columns and 0 <= row < rows):
            continue
        pixel = int(row) * columns + int(column)
        pixels[i] = pixel
        values[i] = value
        if value < nearest[pixel]:
            nearest[pixel] = value
    return nearest


@compiled
def _surface(
    pixels: NDArray[np.int32], values: NDArray[np.float32], nearest: NDArray[np.float32]
) -> FloatArray:
    """(pixels, 3): count and sum of the values of the nearest surface, and count of all returns."""
    surface = np.zeros((len(nearest), 3))
    for i in range(len(pixels)):
        pixel = pixels[i]
        if pixel < 0:
            continue
        surface[pixel, 2] += 1
        if values[i] <= nearest[pixel] + NEAR_M:
            surface[pixel, 0] += 1
            surface[pixel, 1] += values[i]
    return surface


@compiled
def _seen(surface: FloatArray, columns: int, rows: int) -> NDArray[np.float32]:
    """(rows, columns): the surfaces' means, less what shows through gaps in nearer ones."""
    seen = np.full((rows, columns), np.nan, dtype=np.float32)
    for row in range(rows):
        for column in range(columns):
            pixel = row * columns + column
            if surface[pixel, 0] == 0:
                continue
            value = surface[pixel, 1] / surface[pixel, 0]
            limit = max(NEAR_M, BEHIND_RATIO * value)
            in_front = level = 0
            outweighed = False
            for r in range(max(0, row - 1), min(rows, row + 2)):
                for c in range(max(0, column - 1), min(columns, column + 2)):
                    other = r * columns + c
                    if other == pixel or surface[other, 0] == 0:
                        continue
                    distance = value - surface[other, 1] / surface[other, 0]
                    if distance > limit:
                        in_front += 1
                    elif distance > -limit:
                        level += 1
                        outweighed |= surface[pixel, 0] < STRAY_SHARE * surface[other, 0]
            if outweighed and surface[pixel, 0] < STRAY_SHARE * surface[pixel, 2]:
                continue
            if surface[pixel, 0] > FEW or in_front < 2 or in_front <= level:
                seen[row, column] = value
    return seen

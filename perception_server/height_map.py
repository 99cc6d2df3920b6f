"""Terrain from above: one height per cell, holes where nothing answers or the answers contradict each other.

A cell whose returns agree has their mean. The others are what this module is about: a scanner's range
noise (10 mm) spreads the returns of a vertical face over its neighbours, and a single one of them in a
cell of floor beside a wall would be an error of metres. So a cell of mixed heights is read by where the
face in and around it stands: inside the cell, the upper level counts (walls and steps show); outside it,
the face's returns are noise, and what remains must be a level that its neighbours share. A cell with too
little evidence to tell stays a hole: nothing is interpolated. Robust blending after Team MIT's (mean if
the returns agree, else the upper end), see docs/perception.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from perception_server.compiled import compiled
from perception_server.frames import FloatArray
from perception_server.sightlines import drop_what_is_beneath

AGREE_M = 0.05  # returns of a cell within this are of one surface: +-2.5 sigma of a scanner
LEVEL_M = 0.04  # thickness of a horizontal surface as seen in a cell: the noise left in its height
SAME_M = 0.03  # neighbours within this share a level
TALL_M = 0.5  # above its surroundings: a wall or a post, not a step
COARSE_M = 0.1  # larger cells than this hold more than noise moves: the upper level counts
FACE_MARGIN_M = 0.008  # a face must stand this far inside a cell to be its own: most of the noise
FACE_SHARE = 0.6  # of the most returns between levels that a cell nearby has
BEHIND_SHARE = 0.5  # of a cell's own, in the cell behind it: the face stands on their border
SPILL_RATIO = 0.25  # of a cell's width, from its centre towards the cell behind
STRAY_SHARE = 0.25  # of a neighbour's returns above its low level
LONE = 1.0  # votes: of a single return
FEW = 3  # returns that may all be noise

IntPair: TypeAlias = tuple[int, int]
_HOLE, _FLAT, _MIXED, _FACE = 0, 1, 2, 3
_COUNT, _SUM, _LOWEST, _HIGHEST = 0, 1, 2, 3


@dataclass(frozen=True, slots=True)
class Grid:
    """Cells of a height map in the view's frame: columns along x, rows along y, from the lower corner."""

    min_x_m: float
    min_y_m: float
    resolution_m: float
    columns: int
    rows: int

    @property
    def max_x_m(self) -> float:
        """The far edge along x."""
        return self.min_x_m + self.columns * self.resolution_m

    @property
    def max_y_m(self) -> float:
        """The far edge along y."""
        return self.min_y_m + self.rows * self.resolution_m

    def with_margin(self) -> Grid:
        """One cell more on every side: cells at the edge need neighbours as well."""
        step = self.resolution_m
        return Grid(self.min_x_m - step, self.min_y_m - step, step, self.columns + 2, self.rows + 2)


def render_height_map(
    points_m: NDArray[np.float32], grid: Grid, origins_m: NDArray[np.float32], stops: NDArray[np.int64]
) -> NDArray[np.float32]:
    """(rows, columns) heights in metres, NaN for holes; row 0 at the lowest y, column 0 at the lowest x.

    points_m: (N, 3) in the view's frame, of the grid with its margin; others are passed over.
    origins_m: (S, 3), where each scan was taken from; stops: (S,), where in points_m each one's points end.
    """
    wide = grid.with_margin()
    cells = np.empty(len(points_m), dtype=np.int32)
    lowest = np.zeros(wide.columns * wide.rows, dtype=np.int32)
    levels = _levels(
        points_m, wide.min_x_m, wide.min_y_m, 1 / wide.resolution_m, wide.columns, wide.rows, cells, lowest
    )
    parts = _parts(points_m, cells, levels, wide.min_x_m, wide.min_y_m, wide.resolution_m, wide.columns)
    kinds = _kinds(levels, parts, wide.columns, wide.rows, wide.resolution_m)
    sensor_m = origins_m.mean(axis=0).tolist() if len(origins_m) else (0.0, 0.0)
    seen_from = (
        (sensor_m[0] - wide.min_x_m) / wide.resolution_m - 0.5,
        (sensor_m[1] - wide.min_y_m) / wide.resolution_m - 0.5,
    )
    heights = _heights(levels, parts, kinds, wide.columns, wide.rows, *seen_from, grid.resolution_m)
    if grid.resolution_m <= COARSE_M:
        tops = levels[:, _HIGHEST].reshape(heights.shape)
        corner = (wide.min_x_m, wide.min_y_m)
        drop_what_is_beneath(points_m, lowest, heights, tops, origins_m, stops, *corner, wide.resolution_m)
    return np.ascontiguousarray(heights[1:-1, 1:-1])


@compiled
def _levels(
    points: NDArray[np.float32],
    min_x: float,
    min_y: float,
    cells_per_m: float,
    columns: int,
    rows: int,
    cells: NDArray[np.int32],
    lowest: NDArray[np.int32],
) -> FloatArray:
    """(cells, 4): count, sum, lowest and highest of the heights.

    Fills cells (N,), -1 = outside, and lowest (cells,), the index of each one's lowest return.
    """
    levels = np.zeros((rows * columns, 4))
    levels[:, _LOWEST] = np.inf
    levels[:, _HIGHEST] = -np.inf
    for i in range(len(points)):
        across = (points[i, 0] - min_x) * cells_per_m
        along = (points[i, 1] - min_y) * cells_per_m
        if not (0 <= across < columns and 0 <= along < rows):
            cells[i] = -1
            continue
        cell = int(along) * columns + int(across)
        cells[i] = cell
        z = points[i, 2]
        levels[cell, _COUNT] += 1
        levels[cell, _SUM] += z
        if z < levels[cell, _LOWEST]:
            levels[cell, _LOWEST] = z
            lowest[cell] = i
        levels[cell, _HIGHEST] = max(levels[cell, _HIGHEST], z)
    return levels


@compiled
def _parts(
    points: NDArray[np.float32],
    cells: NDArray[np.int32],
    levels: FloatArray,
    min_x: float,
    min_y: float,
    resolution: float,
    columns: int,
) -> FloatArray:
    """(cells, 10) of the cells whose returns disagree: what is at the bottom, at the top, and between.

    Count and sum of heights of the lowest and of the highest level; count and first and second moments,
    about the cell's centre, of what is between them: the returns of a face.
    """
    parts = np.zeros((len(levels), 10))
    for i in range(len(points)):
        cell = cells[i]
        if cell < 0 or levels[cell, _HIGHEST] - levels[cell, _LOWEST] < AGREE_M:
            continue
        z = points[i, 2]
        part = parts[cell]
        if z <= levels[cell, _LOWEST] + LEVEL_M:
            part[0] += 1
            part[1] += z
        elif z >= levels[cell, _HIGHEST] - LEVEL_M:
            part[2] += 1
            part[3] += z
        else:
            x = points[i, 0] - min_x - (cell % columns + 0.5) * resolution
            y = points[i, 1] - min_y - (cell // columns + 0.5) * resolution
            part[4] += 1
            part[5] += x
            part[6] += y
            part[7] += x * x
            part[8] += x * y
            part[9] += y * y
    return parts


@compiled
def _kinds(
    levels: FloatArray, parts: FloatArray, columns: int, rows: int, resolution: float
) -> NDArray[np.int8]:
    """(rows, columns): hole, flat, mixed, or mixed with a face that stands inside the cell."""
    kinds = np.full((rows, columns), _HOLE, dtype=np.int8)
    sums = np.zeros(6)
    for row in range(rows):
        for column in range(columns):
            cell = row * columns + column
            if levels[cell, _COUNT] == 0:
                continue
            if levels[cell, _HIGHEST] - levels[cell, _LOWEST] < AGREE_M:
                kinds[row, column] = _FLAT
                continue
            kinds[row, column] = _MIXED
            most = _sum_around(parts, row, column, columns, rows, resolution, sums)
            if sums[0] >= 3 and parts[cell, 4] >= FACE_SHARE * most and _line_inside(sums, resolution):
                kinds[row, column] = _FACE
    return kinds


@compiled
def _sum_around(
    parts: FloatArray, row: int, column: int, columns: int, rows: int, resolution: float, sums: FloatArray
) -> float:
    """Moments of the faces' returns in the 3 x 3 cells, about the middle one's centre; most in any cell."""
    most = 0.0
    sums[:] = 0.0
    for r in range(max(0, row - 1), min(rows, row + 2)):
        for c in range(max(0, column - 1), min(columns, column + 2)):
            part = parts[r * columns + c]
            n, sx, sy = part[4], part[5], part[6]
            x, y = (c - column) * resolution, (r - row) * resolution
            most = max(most, n)
            sums[0] += n
            sums[1] += sx + x * n
            sums[2] += sy + y * n
            sums[3] += part[7] + 2 * x * sx + x * x * n
            sums[4] += part[8] + x * sy + y * sx + x * y * n
            sums[5] += part[9] + 2 * y * sy + y * y * n
    return most


@compiled
def _line_inside(sums: FloatArray, resolution: float) -> bool:
    """Whether the line through the faces' returns, seen from above, surely passes through the cell.

    The line goes through their mean along their longest spread; how far it may be off is what their
    spread across leaves of n returns, twice over.
    """
    n = sums[0]
    x, y = sums[1] / n, sums[2] / n
    xx, xy, yy = sums[3] / n - x * x, sums[4] / n - x * y, sums[5] / n - y * y
    across = (xx + yy) / 2 - np.sqrt((xx - yy) ** 2 / 4 + xy * xy)  # smallest eigenvalue
    normal_x, normal_y = xy, across - xx
    length = np.sqrt(normal_x * normal_x + normal_y * normal_y)
    if length < 1e-9:  # along an axis
        normal_x, normal_y, length = (1.0, 0.0, 1.0) if xx < yy else (0.0, 1.0, 1.0)
    offset = abs(normal_x * x + normal_y * y) / length
    reach = resolution / 2 * (abs(normal_x) + abs(normal_y)) / length
    return bool(offset < reach - FACE_MARGIN_M - 2 * np.sqrt(max(across, 0.0) / n))


@compiled
def _heights(
    levels: FloatArray,
    parts: FloatArray,
    kinds: NDArray[np.int8],
    columns: int,
    rows: int,
    sensor_column: float,
    sensor_row: float,
    resolution: float,
) -> NDArray[np.float32]:
    """(rows, columns): each cell's height by its own returns and the levels that its neighbours share."""
    heights = np.full((rows, columns), np.nan, dtype=np.float32)
    around = np.zeros(7)
    for row in range(rows):
        for column in range(columns):
            if kinds[row, column] == _HOLE:
                continue
            cell = row * columns + column
            count, span = levels[cell, _COUNT], levels[cell, _HIGHEST] - levels[cell, _LOWEST]
            if kinds[row, column] == _FLAT:
                low = top = levels[cell, _SUM] / count
            else:
                low = parts[cell, 1] / parts[cell, 0]
                top = parts[cell, 3] / max(parts[cell, 2], 1.0)
            if resolution > COARSE_M:
                heights[row, column] = top
                continue
            across, along = column - sensor_column, row - sensor_row
            far = max(abs(across), abs(along), 1e-9)
            step = (round(across / far), round(along / far))
            behind = _share_behind(parts, row, column, columns, rows, step)
            if kinds[row, column] == _FACE:
                if span < TALL_M or behind < 1 or not _is_spill(parts[cell], step, resolution):
                    heights[row, column] = top
                continue
            _look_around(levels, kinds, row, column, columns, rows, low, top, around)
            if kinds[row, column] == _FLAT:
                if _is_supported(count, around):
                    heights[row, column] = low
                continue
            choice = _choose(parts[cell, 0], parts[cell, 4], parts[cell, 2], span, around)
            if choice > 0 and around[2] <= 1 and span > 0.3 and behind >= BEHIND_SHARE:
                # Which of two cells a face on their border belongs to is for noise to say; it has stood
                # in front of the solid, never behind it.
                choice = 0
            if choice > 0 and _is_outweighed(parts, row, column, columns, rows):
                choice = 0
            if choice != 0:
                heights[row, column] = top if choice > 0 else low
    return heights


@compiled
def _share_behind(parts: FloatArray, row: int, column: int, columns: int, rows: int, step: IntPair) -> float:
    """Returns of a face in the cell behind this one, as the sensor sees it: times those in this one."""
    r, c = row + step[1], column + step[0]
    if not (0 <= r < rows and 0 <= c < columns):
        return 0.0
    return float(parts[r * columns + c, 4] / max(parts[row * columns + column, 4], 1e-9))


@compiled
def _is_spill(part: FloatArray, step: IntPair, resolution: float) -> bool:
    """Whether a cell's returns of a face lie towards the cell behind it, where more of them are."""
    towards = (step[0] * part[5] + step[1] * part[6]) / max(np.sqrt(float(step[0] ** 2 + step[1] ** 2)), 1.0)
    return bool(towards > SPILL_RATIO * resolution * part[4])


@compiled
def _is_outweighed(parts: FloatArray, row: int, column: int, columns: int, rows: int) -> bool:
    """Whether a neighbour has so many more returns above its low level that these here are its noise."""
    own = parts[row * columns + column, 2] + parts[row * columns + column, 4]
    for r in range(max(0, row - 1), min(rows, row + 2)):
        for c in range(max(0, column - 1), min(columns, column + 2)):
            part = parts[r * columns + c]
            if own < STRAY_SHARE * (part[2] + part[4]):
                return True
    return False


@compiled
def _look_around(
    levels: FloatArray,
    kinds: NDArray[np.int8],
    row: int,
    column: int,
    columns: int,
    rows: int,
    low: float,
    top: float,
    around: FloatArray,
) -> None:
    """What the eight neighbours say, into around (7,).

    0 to 2: votes of flat ones (2 each, or 1 from a single return) in all, for the low level, for the top.
    3: mixed neighbours; 4 to 6: whether one of these spans the low level, reaches above the top, has a
    face of its own.
    """
    around[:] = 0.0
    for r in range(max(0, row - 1), min(rows, row + 2)):
        for c in range(max(0, column - 1), min(columns, column + 2)):
            if (r == row and c == column) or kinds[r, c] == _HOLE:
                continue
            cell = r * columns + c
            if kinds[r, c] == _FLAT:
                vote = 1.0 if levels[cell, _COUNT] < 2 else 2.0
                height = levels[cell, _SUM] / levels[cell, _COUNT]
                around[0] += vote
                around[1] += vote if abs(height - low) < SAME_M else 0.0
                around[2] += vote if abs(height - top) < SAME_M else 0.0
            else:
                around[3] += 1.0
                if levels[cell, _LOWEST] - SAME_M < low < levels[cell, _HIGHEST] + SAME_M:
                    around[4] = 1.0
                if levels[cell, _HIGHEST] > top + 2 * SAME_M:
                    around[5] = 1.0
                if kinds[r, c] == _FACE:
                    around[6] = 1.0


@compiled
def _is_supported(count: float, around: FloatArray) -> bool:
    """Whether a flat cell of few returns is more than noise of what stands around it."""
    votes, agree, mixed, spanned = around[0], around[1], around[3], around[4]
    if mixed >= 5:  # seen beneath something whose top was not met here
        return False
    if count > FEW:
        return True
    if agree <= LONE and spanned > 0:  # as may be one more stray of the same face
        return False
    if agree == 0:
        return bool(votes < 3)
    return not (count <= 2 and ((votes - agree >= 3 and votes - agree >= agree) or mixed >= 4))


@compiled
def _choose(low: float, between: float, top: float, span: float, around: FloatArray) -> int:
    """Which level a mixed cell without a face of its own shows: 1 the top, -1 the low one, 0 neither.

    low, between, top: how many returns are where.
    """
    low_shared, top_shared, higher = around[1] > 1, around[2] > 1, around[5] > 0
    clean = between <= 0.5 * top  # two surfaces, one above the other, and no face between them
    if low_shared and top_shared:
        if clean and top >= 2 and top >= 0.25 * low:
            return 1
        if low >= 4 * top:
            return -1
        return 1 if top >= 4 * low else 0
    if low_shared:
        if clean and top >= 2 and top >= 0.5 * low and span < TALL_M and not higher:
            return 1
        if span >= TALL_M and between > low:  # a wall's own cell or the one before it: no floor to walk on
            return 0
        return -1 if low >= (2 if span < 0.3 else 3) else 0
    if top_shared:
        return 1 if top >= 0.3 * (low + between + top) else 0
    return 1 if top >= 3 and low + between + top >= 2 * FEW and around[6] == 0 else 0

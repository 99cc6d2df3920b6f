"""What a map's next cell will hold: several guesses, each with how far it was off nearby.

Guesses are doubles in code units, made with +, -, * and / in a written order, so that every machine makes
the same. A hole takes the mean of its neighbours, weighted by how near they are to a measurement, so that
every cell has neighbours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .compiled import Doubles, doubles, inlined

MARGIN = 3  # columns to either side of the grid
ABOVE = 2  # rows before its first
FIT, MEAN, MEDIAN, ALONG_TOP, NORTH, ALONG_ROW, WEST, BLEND = range(8)
EXPERTS = 8
_TAPS = 9  # neighbours of the fit
_SYSTEM = _TAPS * _TAPS + _TAPS  # its normal equations: matrix, right side
_STRIP = 16  # columns that share one set of sums
_DECAY = 0.98  # of a strip's sums with each of its cells
_RIDGE = 2.0  # pulls the fit to the mean of the neighbours
_FIRST_ERROR = 4.0
_FADING = 0.6  # of a hole's trust against its best neighbour's


class Grid(NamedTuple):
    """The cells so far, with margins: row-major, (rows + 2) x (columns + 6)."""

    value: Doubles  # a code, or a hole's stand-in
    trust: Doubles  # 1 where measured, less the farther from a measurement
    residual: Doubles  # value less the blend of guesses
    error: Doubles  # EXPERTS for each cell: how far each guess was off


class Fit(NamedTuple):
    """A linear fit to the neighbours by least squares, over a window of three strips and some rows."""

    sums: Doubles  # normal equations for each strip
    system: Doubles
    factors: Doubles
    weights: Doubles
    taps: Doubles  # each neighbour's difference from their mean


class Guesses(NamedTuple):
    """EXPERTS guesses at one cell."""

    at: Doubles
    error: Doubles


def fresh_grid(rows: int, columns: int, first: int) -> Grid:
    """A grid that takes `first`, the first measured code, for all that is before it."""
    cells = (rows + ABOVE) * (columns + 2 * MARGIN)
    return Grid(
        value=doubles(np.full(cells, float(first))),
        trust=doubles(np.zeros(cells)),
        residual=doubles(np.zeros(cells)),
        error=doubles(np.full(cells * EXPERTS, _FIRST_ERROR)),
    )


def fresh_fit(columns: int) -> Fit:
    """A fit that has seen nothing; one empty strip stands on either side."""
    strips = (columns + _STRIP - 1) // _STRIP + 2
    return Fit(
        sums=doubles(np.zeros(strips * _SYSTEM)),
        system=doubles(np.zeros(_SYSTEM)),
        factors=doubles(np.zeros(_TAPS * _TAPS)),
        weights=doubles(np.zeros(_TAPS)),
        taps=doubles(np.zeros(_TAPS)),
    )


@inlined
def open_row(grid: Grid, at: int, width: int) -> None:
    """Give the margin before a row's first cell the cell above it."""
    above = at - width
    for k in range(1, MARGIN + 1):
        grid.value[at - k] = grid.value[above]
        grid.trust[at - k] = grid.trust[above] * 0.5
        for e in range(EXPERTS):
            grid.error[(at - k) * EXPERTS + e] = grid.error[above * EXPERTS + e]


@inlined
def close_row(grid: Grid, at: int) -> None:
    """Give the margin from `at` on the row's last cell."""
    for k in range(MARGIN):
        grid.value[at + k] = grid.value[at - 1]
        grid.trust[at + k] = grid.trust[at - 1] * 0.5
        for e in range(EXPERTS):
            grid.error[(at + k) * EXPERTS + e] = grid.error[(at - 1) * EXPERTS + e]


@inlined
def reach_up(grid: Grid, at: int, width: int) -> None:
    """In the first row: what comes above and to the right of a cell is taken for like it."""
    for k in range(1, MARGIN + 1):
        grid.value[at - width + k] = grid.value[at]
        grid.value[at - 2 * width + k] = grid.value[at]


@inlined
def neighbour_mean(grid: Grid, at: int, width: int) -> float:
    """The mean of W, N, NW, NE by trust; the two nearer ones count double."""
    up = at - width
    w = 2.0 * grid.trust[at - 1] + 0.02
    n = 2.0 * grid.trust[up] + 0.02
    nw = grid.trust[up - 1] + 0.01
    ne = grid.trust[up + 1] + 0.01
    total = w * grid.value[at - 1] + n * grid.value[up] + nw * grid.value[up - 1] + ne * grid.value[up + 1]
    return float(total / (w + n + nw + ne))


@inlined
def pass_hole(grid: Grid, at: int, width: int) -> None:
    """Fill a hole, so that it can be a neighbour."""
    up = at - width
    grid.value[at] = neighbour_mean(grid, at, width)
    best = max(grid.trust[at - 1], grid.trust[up])
    grid.trust[at] = max(best, max(grid.trust[up - 1], grid.trust[up + 1])) * _FADING
    grid.residual[at] = (grid.residual[at - 1] + grid.residual[up]) * 0.5
    for e in range(EXPERTS):
        near = grid.error[(at - 1) * EXPERTS + e] + grid.error[up * EXPERTS + e]
        grid.error[at * EXPERTS + e] = near * 0.5


@inlined
def guess(grid: Grid, fit: Fit, guesses: Guesses, at: int, width: int, column: int) -> None:
    """Fill `guesses` for the cell at `at`: the last, BLEND, is the others by their recent errors."""
    value = grid.value
    w, n = value[at - 1], value[at - width]
    nw, ne = value[at - width - 1], value[at - width + 1]
    mean = neighbour_mean(grid, at, width)
    high, low = max(w, n), min(w, n)
    at_guess = guesses.at
    at_guess[FIT] = _fitted(grid, fit, at, width, column, mean)
    at_guess[MEAN] = mean
    at_guess[MEDIAN] = low if nw >= high else high if nw <= low else w + n - nw
    at_guess[ALONG_TOP] = w + (ne - n) * 0.5
    at_guess[NORTH] = n
    at_guess[ALONG_ROW] = 2.0 * w - value[at - 2]
    at_guess[WEST] = w
    total, weights = 0.0, 0.0
    for e in range(EXPERTS):
        error = _recent_error(grid, at, width, e)
        guesses.error[e] = error
        if e != BLEND:
            weight = 1.0 / (error * error + 0.05)
            weights += weight * weight
            total += weight * weight * at_guess[e]
    at_guess[BLEND] = total / weights


@inlined
def _recent_error(grid: Grid, at: int, width: int, expert: int) -> float:
    error = grid.error
    i = at * EXPERTS + expert
    up = i - width * EXPERTS
    near = 2.0 * error[i - EXPERTS] + 2.0 * error[up] + error[up - EXPERTS] + error[up + EXPERTS]
    far = 0.5 * error[i - 2 * EXPERTS] + 0.5 * error[up - width * EXPERTS]
    return float((near + far) / 7.0)


@inlined
def _fitted(grid: Grid, fit: Fit, at: int, width: int, column: int, mean: float) -> float:
    """The fit's guess: the mean, and each neighbour's difference from it by its weight."""
    value, taps = grid.value, fit.taps
    taps[0] = value[at - 1] - mean
    taps[1] = value[at - width] - mean
    taps[2] = value[at - width - 1] - mean
    taps[3] = value[at - width + 1] - mean
    taps[4] = value[at - 2] - mean
    taps[5] = value[at - 2 * width] - mean
    taps[6] = value[at - width + 2] - mean
    taps[7] = value[at - 2 * width + 1] - mean
    taps[8] = value[at - width - 2] - mean
    left = column // _STRIP * _SYSTEM
    here = left + _SYSTEM
    right = here + _SYSTEM
    for k in range(_SYSTEM):
        fit.system[k] = fit.sums[left + k] + 2.0 * fit.sums[here + k] + fit.sums[right + k]
    _solve(fit)
    total = mean
    for k in range(_TAPS):
        total += fit.weights[k] * taps[k]
    return total


@inlined
def _solve(fit: Fit) -> None:
    """weights = (matrix + ridge)⁻¹ right side, by L D Lᵀ, of which only the lower half is read."""
    a, lower, x = fit.system, fit.factors, fit.weights
    for i in range(_TAPS):
        for j in range(i):
            s = a[i * _TAPS + j]
            for k in range(j):
                s -= lower[i * _TAPS + k] * lower[j * _TAPS + k] * lower[k * _TAPS + k]
            lower[i * _TAPS + j] = s / lower[j * _TAPS + j]
        s = a[i * _TAPS + i] + _RIDGE
        for k in range(i):
            s -= lower[i * _TAPS + k] * lower[i * _TAPS + k] * lower[k * _TAPS + k]
        lower[i * _TAPS + i] = max(s, 1e-9 * a[i * _TAPS + i] + 1e-9)
    for i in range(_TAPS):
        s = a[_TAPS * _TAPS + i]
        for k in range(i):
            s -= lower[i * _TAPS + k] * x[k]
        x[i] = s
    for i in range(_TAPS):
        x[i] = x[i] / lower[i * _TAPS + i]
    for i in range(_TAPS - 1, -1, -1):
        s = x[i]
        for k in range(i + 1, _TAPS):
            s -= lower[k * _TAPS + i] * x[k]
        x[i] = s


@inlined
def learn_cell(grid: Grid, fit: Fit, guesses: Guesses, at: int, column: int, code: int, blend: float) -> None:
    """Enter a measured cell, and what each guess was off."""
    value = float(code)
    grid.value[at] = value
    grid.trust[at] = 1.0
    grid.residual[at] = value - blend
    for e in range(EXPERTS):
        off = value - guesses.at[e]
        grid.error[at * EXPERTS + e] = off if off >= 0.0 else -off
    target = value - guesses.at[MEAN]
    here = (column // _STRIP + 1) * _SYSTEM
    sums, taps = fit.sums, fit.taps
    for i in range(_TAPS):
        for j in range(i + 1):
            k = here + i * _TAPS + j
            sums[k] = sums[k] * _DECAY + taps[i] * taps[j]
        k = here + _TAPS * _TAPS + i
        sums[k] = sums[k] * _DECAY + taps[i] * target

"""The codes of a map's measured cells, in raster order, by context mixing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .binary_coder import is_exhausted
from .cell_experts import (
    ABOVE,
    BLEND,
    EXPERTS,
    MARGIN,
    Fit,
    Grid,
    Guesses,
    close_row,
    fresh_fit,
    fresh_grid,
    guess,
    learn_cell,
    open_row,
    pass_hole,
    reach_up,
)
from .compiled import Ints, compiled, doubles, inlined, ints
from .context_mixing import TABLES, Tables
from .quantisation import HOLE
from .residual_coder import SPREADS, ResidualModel, code_residual, fresh_residual_model


def code_cell_values(
    coder: Ints, data: NDArray[np.uint8], codes: NDArray[np.int64], levels: int, first: int
) -> NDArray[np.int64]:
    """Write the codes to the coder, or read them; returns them, (rows, columns).

    codes: (rows, columns), HOLE in holes; what else they hold is ignored when reading. first: the code
    of the first measured cell, or near it.
    """
    rows, columns = codes.shape
    cells = ints(codes)
    guesses = Guesses(doubles(np.zeros(EXPERTS)), doubles(np.zeros(EXPERTS)))
    grid, fit = fresh_grid(rows, columns, first), fresh_fit(columns)
    model = fresh_residual_model()
    _code_rows(coder, data, cells, rows, columns, levels, TABLES, grid, fit, guesses, model)
    return np.asarray(cells, dtype=np.int64).reshape(rows, columns)


@compiled
def _code_rows(
    coder: Ints,
    data: NDArray[np.uint8],
    cells: Ints,
    rows: int,
    columns: int,
    levels: int,
    tables: Tables,
    grid: Grid,
    fit: Fit,
    guesses: Guesses,
    model: ResidualModel,
) -> None:
    width = columns + 2 * MARGIN
    for row in range(rows):
        if is_exhausted(coder, data):
            return
        start = (row + ABOVE) * width + MARGIN
        open_row(grid, start, width)
        for column in range(columns):
            at = start + column
            code = cells[row * columns + column]
            if code == HOLE:
                pass_hole(grid, at, width)
            else:
                guess(grid, fit, guesses, at, width, column)
                blend = min(max(guesses.at[BLEND], 0.0), levels - 1.0)
                whole = int(blend + 0.5)
                spread = _find_contexts(model.contexts, grid, guesses, at, width, blend, whole)
                code = whole + code_residual(
                    coder, data, code - whole, tables, model, guesses, whole, levels, spread
                )
                cells[row * columns + column] = code
                learn_cell(grid, fit, guesses, at, column, code, blend)
            if row == 0:
                reach_up(grid, at, width)
        close_row(grid, start + columns)


@inlined
def _find_contexts(
    contexts: Ints, grid: Grid, guesses: Guesses, at: int, width: int, blend: float, whole: int
) -> int:
    """Set the residual's contexts; returns the class of its expected size."""
    value, trust = grid.value, grid.trust
    up = at - width
    expected = guesses.error[BLEND]
    spread = min(_octave(expected * 3.0 + 0.5), SPREADS - 1)
    scale = 1.0 / (expected + 0.3)
    least, most = guesses.at[0], guesses.at[0]
    for e in range(1, BLEND):
        least = min(least, guesses.at[e])
        most = max(most, guesses.at[e])
    near = int((trust[at - 1] + trust[up] + trust[up - 1] + trust[up + 1]) * 1.99)
    contexts[0] = int(expected * 6.0) if expected < 4.0 else 24 + spread
    contexts[1] = _nine((value[at - 1] - blend) * scale) * 9 + _nine((value[up] - blend) * scale)
    contexts[2] = _nine(grid.residual[at - 1]) * 9 + _nine(grid.residual[up])
    contexts[3] = near * SPREADS + spread
    contexts[4] = int((blend - whole + 0.5) * 7.99) * SPREADS + spread
    contexts[5] = min(_octave((most - least) * 2.0), 18) * SPREADS + spread
    contexts[6] = (int(value[at - 1]) * 31 + int(value[up]) * 17) & 511
    return spread


@inlined
def _octave(amount: float) -> int:
    """0 below 1, 1 below 2, 2 below 4, and so on."""
    octave = 0
    while amount >= 1.0 and octave < 32:
        amount *= 0.5
        octave += 1
    return octave


@inlined
def _nine(amount: float) -> int:
    """A signed amount in nine classes, 4 in the middle."""
    size = amount if amount >= 0.0 else -amount
    grade = 0 if size < 0.3 else 1 if size < 1.0 else 2 if size < 2.5 else 3 if size < 7.0 else 4
    return 4 + grade if amount >= 0.0 else 4 - grade

"""Which cells hold a measurement: one bit a cell, coded by context mixing before any value.

Solid regions are told by the cells around; the dots that a scanner leaves on a grid are told by a linear
classifier over 48 earlier cells, one for each strip of 24 columns, which learns the local slant and
spacing of the scan lines while it codes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .binary_coder import code_bit, is_exhausted
from .compiled import Ints, compiled, inlined, ints
from .context_mixing import FRESH, MIXER_ONE, TABLES, Tables, confident_logit, learned, mixed, squash, train

_MARGIN = 8  # cells of hole around the grid, so that every neighbour exists
_REACH = (7, 7, 5, 4, 3)  # columns to either side that the classifier sees, 0 to 4 rows up
_STRIP = 24  # columns that share a classifier
_CONTEXT_SIZES = (16, 128, 4096, 1 << 16, 1024, 1024, 512, 512, 1024, 1152, 128, 2048)
_CONTEXTS = len(_CONTEXT_SIZES)
_INPUTS = _CONTEXTS + 2  # the classifier's logit, a constant
_MIXER_SHIFT = 14
_CLASSIFIER_SHIFT = 13
_LIMIT = 250  # bits after which a context's mean begins to forget
_WINDOW = 40  # cells in the counted window
_BIAS = 256
_FIRST_WEIGHT = MIXER_ONE * 15 // 100


class MaskModel(NamedTuple):
    """What is learnt of one mask; made anew for every map."""

    cells: Ints  # (rows + margins) x (columns + margins), 1 where measured
    same_above: Ints  # per column: for how many rows it has not changed
    slots: Ints  # the contexts' probabilities, one table after another
    tables_at: Ints  # where each context's table starts
    taps: Ints  # how far back each cell of the classifier lies
    classifiers: Ints  # weights per strip
    inputs: Ints
    bits: Ints  # the classifier's inputs
    slot_of: Ints  # the slot of each context
    near_weights: Ints  # mixing weights by the nearest cells
    slant_weights: Ints  # mixing weights by the classifier's opinion


def fresh_mask_model(rows: int, columns: int) -> MaskModel:
    """A model that has seen nothing."""
    width = columns + 2 * _MARGIN
    taps = [k for k in range(1, _REACH[0] + 1)]
    taps += [up * width + k for up in range(1, len(_REACH)) for k in range(-_REACH[up], _REACH[up] + 1)]
    return MaskModel(
        cells=ints(np.zeros((rows + _MARGIN) * width)),
        same_above=ints(np.zeros(columns)),
        slots=ints(np.full(sum(_CONTEXT_SIZES), FRESH)),
        tables_at=ints(np.cumsum((0, *_CONTEXT_SIZES[:-1]))),
        taps=ints(taps),
        classifiers=ints(np.zeros((columns // _STRIP + 1) * (len(taps) + 1))),
        inputs=ints(np.zeros(_INPUTS)),
        bits=ints(np.zeros(len(taps) + 1)),
        slot_of=ints(np.zeros(_CONTEXTS)),
        near_weights=ints(np.full(64 * _INPUTS, _FIRST_WEIGHT)),
        slant_weights=ints(np.full(16 * _INPUTS, _FIRST_WEIGHT)),
    )


def code_hole_mask(
    coder: Ints, data: NDArray[np.uint8], valid: NDArray[np.bool_] | None, rows: int, columns: int
) -> NDArray[np.bool_]:
    """Write `valid` (rows, columns) to the coder, or read and return one; it is then None."""
    bits = ints(np.zeros(rows * columns) if valid is None else valid)
    _code_rows(coder, data, bits, rows, columns, TABLES, fresh_mask_model(rows, columns))
    return np.asarray(bits, dtype=np.bool_).reshape(rows, columns)


@compiled
def _code_rows(
    coder: Ints,
    data: NDArray[np.uint8],
    bits: Ints,
    rows: int,
    columns: int,
    tables: Tables,
    model: MaskModel,
) -> None:
    width = columns + 2 * _MARGIN
    for row in range(rows):
        if is_exhausted(coder, data):
            return
        same_left = 0
        for column in range(columns):
            at = (row + _MARGIN) * width + _MARGIN + column
            near, window = _find_contexts(model, at, width, same_left, model.same_above[column])
            bit = _code_cell(
                coder, data, bits[row * columns + column], tables, model, at, column, near, window
            )
            bits[row * columns + column] = bit
            model.cells[at] = bit
            same_left = same_left + 1 if bit == model.cells[at - 1] else 1
            above = model.same_above[column]
            model.same_above[column] = above + 1 if bit == model.cells[at - width] else 1


@inlined
def _code_cell(
    coder: Ints,
    data: NDArray[np.uint8],
    bit: int,
    tables: Tables,
    model: MaskModel,
    at: int,
    column: int,
    near: int,
    window: int,
) -> int:
    """Code one cell and learn from it; returns its bit."""
    count = len(model.bits)
    strip = column // _STRIP * count
    is_mixed = 0 < window < _WINDOW  # where all is one, the classifier has nothing to add
    slant = _classify(model, at, strip) if is_mixed else 0
    opinion = (slant + 2048) >> 8
    model.slot_of[10] += (slant + 2048) >> 5
    model.slot_of[11] += opinion * 128
    for i in range(_CONTEXTS):
        model.inputs[i] = confident_logit(tables, model.slots[model.slot_of[i]])
    model.inputs[_CONTEXTS] = slant
    model.inputs[_CONTEXTS + 1] = _BIAS
    near_at = near * _INPUTS
    slant_at = opinion * _INPUTS
    by_near = mixed(model.near_weights, near_at, model.inputs, _INPUTS)
    by_slant = mixed(model.slant_weights, slant_at, model.inputs, _INPUTS)
    p = squash(tables.squash, (by_near + by_slant) >> 1)
    bit = code_bit(coder, data, bit, min(max(p, 1), 65535))
    want = bit << 16
    near_error = want - squash(tables.squash, by_near)
    slant_error = want - squash(tables.squash, by_slant)
    train(model.near_weights, near_at, model.inputs, _INPUTS, near_error, _MIXER_SHIFT)
    train(model.slant_weights, slant_at, model.inputs, _INPUTS, slant_error, _MIXER_SHIFT)
    if is_mixed:
        error = want - squash(tables.squash, slant)
        train(model.classifiers, strip, model.bits, count, error, _CLASSIFIER_SHIFT)
    for i in range(_CONTEXTS):
        slot = model.slot_of[i]
        model.slots[slot] = learned(tables.rate, model.slots[slot], bit, _LIMIT)
    return bit


@inlined
def _classify(model: MaskModel, at: int, strip: int) -> int:
    """The strip's linear classifier: a logit within ±8 nats."""
    count = len(model.taps)
    for i in range(count):
        model.bits[i] = _BIAS if model.cells[at - model.taps[i]] else -_BIAS
    model.bits[count] = _BIAS
    return min(max(mixed(model.classifiers, strip, model.bits, count + 1), -2047), 2047)


@inlined
def _find_contexts(model: MaskModel, at: int, width: int, same_left: int, same_above: int) -> tuple[int, int]:
    """Set each context's slot; returns which mixing weights the near cells choose, and the window's count."""
    cells = model.cells
    up, up2, up3 = at - width, at - 2 * width, at - 3 * width
    w, ww, www, wwww = cells[at - 1], cells[at - 2], cells[at - 3], cells[at - 4]
    n, nn, nnn = cells[up], cells[up2], cells[up3]
    four = w | n << 1 | cells[up - 1] << 2 | cells[up + 1] << 3
    seven = four | ww << 4 | nn << 5 | cells[up + 2] << 6
    twelve = seven | cells[up - 2] << 7 | www << 8 | cells[up2 - 1] << 9 | cells[up2 + 1] << 10 | nnn << 11
    row_above, rows_above = 0, 0
    for k in range(-5, 6):
        row_above += cells[up + k]
        rows_above += cells[up2 + k] + cells[up3 + k]
    left = w + ww + www + wwww + cells[at - 5] + cells[at - 6] + cells[at - 7]
    window = row_above + rows_above + left
    ahead = 1
    while ahead < 8 and cells[up + ahead] == n:
        ahead += 1
    runs = _run_class(same_left) * 8 + _run_class(same_above)
    index = model.slot_of
    index[0] = four
    index[1] = seven
    index[2] = twelve
    index[3] = (
        twelve | cells[up - 3] << 12 | cells[up + 3] << 13 | cells[up2 - 2] << 14 | cells[up2 + 2] << 15
    )
    index[4] = window * 16 + four
    index[5] = runs * 16 + four
    index[6] = ((ahead - 1) * 8 + _run_class(same_left)) * 8 + (w | n << 1 | nn << 2)
    index[7] = w | ww << 1 | www << 2 | wwww << 3 | cells[at - 5] << 4 | cells[at - 6] << 5 | (four >> 1) << 6
    column = n | nn << 1 | nnn << 2 | cells[at - 4 * width] << 3
    index[8] = column | w << 4 | (four >> 2) << 5 | cells[up2 - 1] << 7 | cells[up2 + 1] << 8 | ww << 9
    index[9] = row_above + 12 * (left + 8 * (rows_above // 2))
    index[10] = 0
    index[11] = seven
    for i in range(_CONTEXTS):
        index[i] += model.tables_at[i]
    return four * 4 + min(same_above, 3), window


@inlined
def _run_class(length: int) -> int:
    """Eight classes of run length."""
    if length < 4:
        return length
    return 4 if length < 6 else 5 if length < 10 else 6 if length < 20 else 7

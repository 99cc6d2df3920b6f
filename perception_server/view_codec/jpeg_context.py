"""A JPEG's quantised coefficients under context mixing: each block from those above and to the left.

In a block, first the coefficients that vary both across and down, then the row and the column that vary
only across and only down, then the DC, so that each is predicted from all that comes before: at the
border of two blocks their pictures should meet, which along one side is a sum of cosines that are 1 or
-1 there, and says what the last unknown coefficient is. Source: the order and that prediction are those
of D. Horn and others, "The Design, Implementation, and Deployment of a System to Transparently Compress
Hundreds of Petabytes of Image Files For a File-Storage Service", NSDI 2017; the contexts are our own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .binary_coder import check_end, decoder, encoded_bytes, encoder
from .compiled import Ints, compiled, ints
from .errors import DecodeError
from .jpeg_file import JpegFrame
from .jpeg_model import (
    COUNT_KINDS,
    INPUTS,
    VALUE_SETS,
    Model,
    code_count,
    code_number,
    fresh_model,
)
from .jpeg_scan import LEAST_DC, MOST_AC, MOST_DC
from .mixer import rough

MAX_BLOCKS = 1 << 14  # a 4:2:0 picture of 640x480 has 7,200
MOST_DECISIONS = 2_500_000  # of a message: half a second, and 15 times what 512x272 pixels take
_MOST_BLOCK_BYTES = 128  # twice what quality 100 takes
_INTERIOR = 49
_COUNT_BITS, _EDGE_COUNT_BITS = 6, 3
_ROUGHEST = 11

# Where the sets of weights start; each is for luma, then for chroma.
_COUNT_SET = 0
_INTERIOR_SET = _COUNT_SET + 2 * _COUNT_BITS
_EDGE_COUNT_SET = _INTERIOR_SET + 2 * _ROUGHEST * VALUE_SETS
_EDGE_SET = _EDGE_COUNT_SET + 4 * _EDGE_COUNT_BITS
_DC_SET = _EDGE_SET + 4 * 8 * VALUE_SETS
_SETS = _DC_SET + 2 * 3 * VALUE_SETS

# What the contexts are of: a number that keeps them apart.
_OF_INTERIOR, _OF_EDGE, _OF_DC = 1, 2, 3

_HALF_ROOT, _ROOT = 181, 362  # 2 ** -0.5 and 2 ** 0.5, in 1/256
HERE, WEST, NORTH, NORTH_WEST, NORTH_EAST, TWIN = range(6)  # blocks, as `Plane.near` has them


def _zigzag() -> list[tuple[int, int]]:
    """Frequency down and across of each place in zigzag order."""
    order = []
    for diagonal in range(15):
        steps = [(i, diagonal - i) for i in range(max(0, diagonal - 7), min(diagonal, 7) + 1)]
        order += steps if diagonal % 2 else steps[::-1]
    return order


_ORDER = _zigzag()
_PLACES = ints([_ORDER.index((i // 8, i % 8)) for i in range(64)])  # by 8 * down + across
_INSIDE = ints([8 * down + across for down, across in _ORDER if down and across])


class Plane(NamedTuple):
    """One component: its coefficients, what is known of its blocks, and where the next one's are."""

    coefficients: Ints
    steps: Ints  # 64 quantisation steps, in zigzag order
    inside: Ints  # per block, how many of the 49 are not 0
    edges: Ints  # per block two, how many of the 7 of the row and of the column are not 0
    surprise: Ints  # per block, DC less its prediction
    near: Ints  # where the blocks HERE to TWIN are, in blocks; -1 if there is none
    places: Ints
    order: Ints


def encode_coefficients(coefficients: Ints, frame: JpegFrame) -> bytes | None:
    """The coefficients of a frame, as `jpeg_scan` lays them out; None where that is too long or too large."""
    if frame.blocks > MAX_BLOCKS:
        return None
    coder, data = encoder(frame.blocks * _MOST_BLOCK_BYTES + 64)
    try:
        return encoded_bytes(coder, data) if _code(coder, data, coefficients, frame) else None
    except OverflowError:
        return None


def decode_coefficients(data: bytes, frame: JpegFrame) -> Ints:
    """The inverse. Raises DecodeError."""
    if frame.blocks > MAX_BLOCKS:
        raise DecodeError(f"a JPEG of {frame.blocks} blocks is above {MAX_BLOCKS}")
    coefficients = ints(np.zeros(64 * frame.blocks))
    coder, octets = decoder(data)
    if not _code(coder, octets, coefficients, frame):
        raise DecodeError("the JPEG's coefficients are out of range, or take too long to read")
    check_end(coder, octets)
    return coefficients


def _code(coder: Ints, data: NDArray[np.uint8], coefficients: Ints, frame: JpegFrame) -> bool:
    """Write or read all components; False if they cannot be, or only in too many decisions."""
    model, first = fresh_model(coder, data, _SETS), 0
    firsts: list[int] = []
    inside, edges = ints(np.zeros(frame.blocks)), ints(np.zeros(2 * frame.blocks))
    surprise, shape = ints(np.zeros(frame.blocks)), (0, 0)
    for number, part in enumerate(frame.components):
        steps, near = ints(list(part.steps)), ints([0] * 6)
        plane = Plane(coefficients, steps, inside, edges, surprise, near, _PLACES, _INSIDE)
        twins = number == 2 and (part.rows, part.columns) == shape
        twin, shape = firsts[1] if twins else -1, (part.rows, part.columns)
        if not _code_plane(model, plane, part.rows, part.columns, first, twin, min(number, 1)):
            return False
        firsts.append(first)
        first += part.blocks
    return True


@compiled
def _code_plane(
    model: Model, plane: Plane, rows: int, columns: int, first: int, twin: int, chroma: int
) -> bool:
    """Write or read the blocks of a component, the first of which is block `first`; `twin`: as of another."""
    for row in range(rows):
        for column in range(columns):
            here = row * columns + column
            plane.near[HERE] = first + here
            plane.near[WEST] = first + here - 1 if column else -1
            plane.near[NORTH] = first + here - columns if row else -1
            plane.near[NORTH_WEST] = first + here - columns - 1 if row and column else -1
            plane.near[NORTH_EAST] = first + here - columns + 1 if row and column + 1 < columns else -1
            plane.near[TWIN] = twin + here if twin >= 0 else -1
            sound = _code_interior(model, plane, chroma)
            sound = sound and _code_edge(model, plane, 0, chroma) and _code_edge(model, plane, 1, chroma)
            if not sound or not _code_dc(model, plane, chroma) or model.mixer.decisions[0] > MOST_DECISIONS:
                return False
    return True


@compiled
def _size(coefficients: Ints, block: int, place: int) -> int:
    """How large a coefficient is; 0 in a block that there is not."""
    return abs(coefficients[64 * block + place]) if block >= 0 else 0


@compiled
def _sign(coefficients: Ints, block: int, place: int) -> int:
    """0, 1 or 2: zero (or no such block), above, below."""
    if block < 0 or coefficients[64 * block + place] == 0:
        return 0
    return 1 if coefficients[64 * block + place] > 0 else 2


@compiled
def _around(coefficients: Ints, near: Ints, place: int) -> int:
    """How large a coefficient is in the blocks about, on the scale of `rough`."""
    beside = _size(coefficients, near[WEST], place) + _size(coefficients, near[NORTH], place)
    corners = _size(coefficients, near[NORTH_WEST], place) + _size(coefficients, near[NORTH_EAST], place)
    return min(rough(2 * beside + corners), 10)


@compiled
def _lower(coefficients: Ints, places: Ints, here: int, down: int, across: int) -> int:
    """How large the block's own coefficients just below a frequency are, on the scale of `rough`."""
    total = 0
    if across > 1:
        total += 2 * _size(coefficients, here, places[8 * down + across - 1])
    if down > 1:
        total += 2 * _size(coefficients, here, places[8 * down + across - 8])
    if across > 1 and down > 1:
        total += _size(coefficients, here, places[8 * down + across - 9])
    if across > 2:
        total += _size(coefficients, here, places[8 * down + across - 2])
    if down > 2:
        total += _size(coefficients, here, places[8 * down + across - 16])
    return min(rough(total), 9)


@compiled
def _of(counts: Ints, block: int) -> int:
    return counts[block] if block >= 0 else 0


@compiled
def _code_inside_count(model: Model, plane: Plane, chroma: int) -> int:
    """Write or read how many of the 49 coefficients are not zero."""
    near, counts, contexts = plane.near, plane.inside, model.contexts
    count = 0
    for i in range(_INTERIOR):
        if plane.coefficients[64 * near[HERE] + plane.places[plane.order[i]]]:
            count += 1
    west, north = _of(counts, near[WEST]), _of(counts, near[NORTH])
    beside = 2 * (west + north) if near[WEST] < 0 or near[NORTH] < 0 else west + north
    corners = _of(counts, near[NORTH_WEST]) + _of(counts, near[NORTH_EAST])
    contexts[0] = min(beside, 40)
    contexts[1] = 1 + west if near[WEST] >= 0 else 0
    contexts[2] = 1 + north if near[NORTH] >= 0 else 0
    contexts[3] = rough(corners + beside)
    contexts[4] = rough(_of(counts, near[TWIN])) * 8 + min(rough(beside), 7)
    contexts[5] = 0
    for i in range(INPUTS):
        contexts[i] = contexts[i] * 2 + chroma
    return code_count(model, count, _COUNT_BITS, COUNT_KINDS[0], _COUNT_SET + chroma * _COUNT_BITS)


@compiled
def _code_interior(model: Model, plane: Plane, chroma: int) -> bool:
    """Write or read the coefficients that vary both across and down."""
    near, contexts, signs = plane.near, model.contexts, model.signs
    count = _code_inside_count(model, plane, chroma)
    plane.inside[near[HERE]] = count
    if count > _INTERIOR:
        return False
    for i in range(_INTERIOR):
        if count == 0:
            break
        down, across = plane.order[i] >> 3, plane.order[i] & 7
        place = plane.places[plane.order[i]]
        around, lower = (
            _around(plane.coefficients, near, place),
            _lower(plane.coefficients, plane.places, near[HERE], down, across),
        )
        left, ahead = min(rough(count), _ROUGHEST - 1), min(rough(_INTERIOR - i), 14)
        contexts[0] = i * 64 + min(count, 20)
        contexts[1] = i * 64 + around
        contexts[2] = (left * 16 + ahead) * 16 + around
        contexts[3] = i * 64 + lower
        contexts[4] = (
            min(rough(_size(plane.coefficients, near[TWIN], place)), 7) * 16 + min(around, 7)
        ) * 16 + lower
        contexts[5] = (lower * 16 + left) * 16 + ahead
        beside = _sign(plane.coefficients, near[WEST], place) * 3 + _sign(
            plane.coefficients, near[NORTH], place
        )
        for j in range(INPUTS):
            contexts[j] = (contexts[j] * 2 + chroma) * 4 + _OF_INTERIOR
            signs[j] = ((i * 2 + chroma) * 9 + beside) * 4 + _OF_INTERIOR
        signs[0] = (_sign(plane.coefficients, near[TWIN], place) * 2 + chroma) * 4 + _OF_INTERIOR
        at = 64 * near[HERE] + place
        weights_set = _INTERIOR_SET + (2 * left + chroma) * VALUE_SETS
        number = code_number(model, plane.coefficients[at], count == _INTERIOR - i, weights_set)
        plane.coefficients[at] = number
        if abs(number) > MOST_AC:
            return False
        if number:
            count -= 1
    return True


@compiled
def _meeting(plane: Plane, other: int, line: int, stride: int) -> int:
    """What the border with block `other` leaves for the first coefficient of a line of the block.

    The line is coefficients `line`, `line` + stride and so on by 8 * down + across; those behind its
    first are known. Returns their quantised unit times steps, times 1 / sqrt 2.
    """
    here, total = 64 * plane.near[HERE], 0
    for i in range(8):
        place = plane.places[line + i * stride]
        there = plane.coefficients[64 * other + place] * plane.steps[place]
        if i == 0:
            total += there * _HALF_ROOT >> 8
        else:
            total += -there if i & 1 else there
            total -= plane.coefficients[here + place] * plane.steps[place]
    return total


@compiled
def _divided(number: int, divisor: int) -> int:
    """Rounded to the nearest, halves away from zero: the same to both sides of it."""
    size = (abs(number) + (divisor >> 1)) // divisor
    return size if number > 0 else -size


@compiled
def _code_edge(model: Model, plane: Plane, side: int, chroma: int) -> bool:
    """Write or read the coefficients that vary only across (side 0) or only down (side 1)."""
    near, edges, contexts = plane.near, plane.edges, model.contexts
    here = 64 * near[HERE]
    along, over = (8, 1) if side else (1, 8)
    count = 0
    for i in range(1, 8):
        if plane.coefficients[here + plane.places[along * i]]:
            count += 1
    west = edges[2 * near[WEST] + side] if near[WEST] >= 0 else 0
    north = edges[2 * near[NORTH] + side] if near[NORTH] >= 0 else 0
    twin = edges[2 * near[TWIN] + side] if near[TWIN] >= 0 else 0
    row = edges[2 * near[HERE]] if side else 0
    inside = plane.inside[near[HERE]]
    contexts[0] = inside
    contexts[1] = west * 8 + north
    contexts[2] = (west + north) * 4 + min(rough(inside) >> 1, 3)
    contexts[3] = twin * 8 + row
    contexts[4] = min(rough(inside), 9) * 8 + row
    contexts[5] = 0
    of = 2 * side + chroma
    for i in range(INPUTS):
        contexts[i] = contexts[i] * 4 + of
    count = code_count(
        model, count, _EDGE_COUNT_BITS, COUNT_KINDS[1], _EDGE_COUNT_SET + of * _EDGE_COUNT_BITS
    )
    edges[2 * near[HERE] + side] = count
    for i in range(1, 8):
        if count == 0:
            break
        place = plane.places[along * i]
        other = near[WEST] if side else near[NORTH]
        expected = 0
        if other >= 0:
            expected = _meeting(plane, other, along * i, over) * _ROOT  # 1/256 of a unit
            expected = _divided(4 * expected, plane.steps[place] << 8)
        _edge_contexts(model, plane, i, of, count, expected)
        weights_set = _EDGE_SET + (4 * i + of) * VALUE_SETS
        number = code_number(model, plane.coefficients[here + place], count == 8 - i, weights_set)
        plane.coefficients[here + place] = number
        if abs(number) > MOST_AC:
            return False
        if number:
            count -= 1
    return count == 0


@compiled
def _edge_contexts(model: Model, plane: Plane, i: int, of: int, count: int, expected: int) -> None:
    """The contexts of coefficient `i` of an edge; `count` are to come; `expected` in quarters of a step."""
    near, contexts, signs = plane.near, model.contexts, model.signs
    along = 8 if of >> 1 else 1
    place = plane.places[along * i]
    before = _size(plane.coefficients, near[HERE], plane.places[along * (i - 1)]) if i > 1 else 0
    around, size = _around(plane.coefficients, near, place), min(rough(abs(expected)), 14)
    which = i * 4 + of
    contexts[0] = which * 64 + count
    contexts[1] = which * 64 + size
    contexts[2] = (which * 16 + around) * 16 + count
    contexts[3] = (size * 16 + around) * 8 + count
    contexts[4] = (which * 16 + min(rough(plane.inside[near[HERE]]), 10)) * 8 + min(rough(before), 5)
    contexts[5] = (
        (size * 16 + min(rough(_size(plane.coefficients, near[TWIN], place)), 7)) * 8 + count
    ) * 8 + i
    west, north = _sign(plane.coefficients, near[WEST], place), _sign(plane.coefficients, near[NORTH], place)
    twin = _sign(plane.coefficients, near[TWIN], place)
    likely = size + 16 if expected < 0 else size
    signs[0] = which * 64 + likely
    signs[1] = likely
    signs[2] = which * 9 + west * 3 + north
    signs[3] = which * 3 + twin
    signs[4] = (likely * 3 + twin) * 4 + of
    signs[5] = (likely * 3 + west) * 3 + north
    for j in range(INPUTS):
        contexts[j] = contexts[j] * 4 + _OF_EDGE
        signs[j] = signs[j] * 4 + _OF_EDGE


@compiled
def _code_dc(model: Model, plane: Plane, chroma: int) -> bool:
    """Write or read the DC, as what the borders to the west and to the north do not foretell."""
    near, contexts, signs, surprise = plane.near, model.contexts, model.signs, plane.surprise
    at, step = 64 * near[HERE], plane.steps[0]
    sides = 0
    west = north = expected = unlike = apart = 0
    if near[WEST] >= 0:
        west = _meeting(plane, near[WEST], 0, 1) * _ROOT
        sides += 1
    if near[NORTH] >= 0:
        north = _meeting(plane, near[NORTH], 0, 8) * _ROOT
        sides += 1
    if sides:
        expected = min(max(_divided(west + north, step * sides << 8), LEAST_DC), MOST_DC)
    if sides == 2:
        unlike = min(rough(abs(west - north) // (step << 8)), 14)
        apart = abs(plane.coefficients[64 * near[WEST]] - plane.coefficients[64 * near[NORTH]])
    twin = _of(surprise, near[TWIN])
    from_west, from_north = _of(surprise, near[WEST]), _of(surprise, near[NORTH])
    inside = plane.inside[near[HERE]]
    edges = plane.edges[2 * near[HERE]] + plane.edges[2 * near[HERE] + 1]
    contexts[0] = unlike
    contexts[1] = min(rough(apart), 15) * 4 + sides
    contexts[2] = min(rough(inside), 10) * 16 + unlike
    contexts[3] = min(rough(abs(from_west) + abs(from_north)), 15) * 4 + sides
    contexts[4] = min(rough(abs(twin)), 12) * 16 + unlike
    contexts[5] = min(rough(edges + inside), 10)
    signs[0] = 0
    signs[1] = 1 if from_west > 0 else 2 if from_west < 0 else 3
    signs[2] = 1 if from_north > 0 else 2 if from_north < 0 else 3
    signs[3] = 1 if twin > 0 else 2 if twin < 0 else 3
    signs[4] = unlike * 2 + (1 if sides == 2 and west > north else 0)
    signs[5] = 5
    for j in range(INPUTS):
        contexts[j] = (contexts[j] * 2 + chroma) * 4 + _OF_DC
        signs[j] = (signs[j] * 2 + chroma) * 4 + _OF_DC
    weights_set = _DC_SET + (2 * sides + chroma) * VALUE_SETS
    number = code_number(model, plane.coefficients[at] - expected, False, weights_set)
    surprise[near[HERE]] = number
    plane.coefficients[at] = expected + number
    return LEAST_DC <= expected + number <= MOST_DC

"""Finding the cells about a cell among the codes of one octree level, by a hash table.

A neighbour is a number 13 + dx + 3 dy + 9 dz, each step -1, 0 or 1; so 13 is the cell itself.
"""

from __future__ import annotations

import numpy as np

from .compiled import Ints, compiled, ints
from .occupancy import Codes

NEIGHBOURS = 27
ITSELF = 13
_X = 0x1249249249249249  # the bits of x in a code; those of y and z are one and two places higher
_HASH = 2_654_435_761  # Knuth's multiplicative hash
_HASH_SHIFT = 15


def _distance(neighbour: int) -> int:
    """How many of the three steps are not 0."""
    return sum(neighbour // 3**axis % 3 != 1 for axis in range(3))


NEAREST_FIRST = ints(sorted(range(NEIGHBOURS), key=lambda neighbour: (_distance(neighbour), neighbour)))


def hash_table(codes: Codes) -> tuple[Ints, Ints]:
    """Keys and places for `find_neighbours`; two to four times as long as the codes."""
    room = 1 << (2 * len(codes)).bit_length()
    keys, places = ints(np.full(room, -1)), ints(np.zeros(room))
    _fill(keys, places, ints(codes))
    return keys, places


@compiled
def find_neighbours(found: Ints, keys: Ints, places: Ints, code: int) -> None:
    """Set found[neighbour] to the place of each neighbour of a code among the codes, or to -1."""
    for neighbour in range(NEIGHBOURS):
        steps = neighbour
        moved = 0
        for axis in range(3):
            along = _moved(code, _X << axis, 1 << axis, steps % 3 - 1)
            if along < 0:
                moved = -1
                break
            moved |= along
            steps //= 3
        found[neighbour] = _place(keys, places, moved) if moved >= 0 else -1


@compiled
def _moved(code: int, bits: int, unit: int, step: int) -> int:
    """A code's bits of one axis, a step farther; -1 past the ends. The bits between are jumped by carries."""
    along = code & bits
    if step < 0:
        return (along - unit) & bits if along else -1
    if step > 0:
        along = ((along | ~bits) + unit) & bits
        return along if along else -1
    return along


@compiled
def _slot(keys: Ints, code: int) -> int:
    """Where a code is in the table, or where it would go."""
    mask = len(keys) - 1
    folded = (code ^ (code >> 31)) & 0x7FFFFFFF
    slot = (folded * _HASH >> _HASH_SHIFT) & mask
    while keys[slot] >= 0 and keys[slot] != code:
        slot = (slot + 1) & mask
    return slot


@compiled
def _fill(keys: Ints, places: Ints, codes: Ints) -> None:
    for place in range(len(codes)):
        slot = _slot(keys, codes[place])
        keys[slot] = codes[place]
        places[slot] = place


@compiled
def _place(keys: Ints, places: Ints, code: int) -> int:
    slot = _slot(keys, code)
    return places[slot] if keys[slot] == code else -1

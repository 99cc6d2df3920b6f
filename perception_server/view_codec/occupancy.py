"""Sets of cubic cells as octrees: which of its eight children each node has, breadth first.

A cell's code interleaves the bits of its three indices, z highest, so that a cell's ancestor k levels
up has the code's bits above 3k. The octree of sorted codes is one byte a node, level by level from the
root; bit i of a byte is child i.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .errors import DecodeError

MAX_DEPTH = 20
MAX_CELLS = 1 << 19  # a message's: every pixel of a depth camera; 6 MB of points
Cells = NDArray[np.int64]  # (N, 3) indices x, y, z, not below 0
Codes = NDArray[np.int64]  # (N,) ascending, no code twice

_SPREADS = (  # how far bits move apart, and the bits that are then in place
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
_ALL_BITS = (1 << 21) - 1


def codes_of(cells: Cells) -> Codes:
    """The codes of a set of cells, each index below 2**MAX_DEPTH."""
    codes = _spread(cells[:, 0]) | _spread(cells[:, 1]) << 1 | _spread(cells[:, 2]) << 2
    return np.unique(codes)


def cells_of(codes: Codes) -> Cells:
    """The cells, in the order of their codes."""
    return np.stack([_gathered(codes >> axis) for axis in range(3)], axis=1)


def levels_of(codes: Codes, depth: int) -> list[NDArray[np.uint8]]:
    """The nodes' bytes, one array a level, root first; none for a depth of 0."""
    levels = []
    for _ in range(depth):
        parents, children = codes >> 3, np.left_shift(1, codes & 7)
        starts = np.flatnonzero(np.diff(parents, prepend=-1))
        levels.append(np.bitwise_or.reduceat(children, starts).astype(np.uint8))
        codes = parents[starts]
    return levels[::-1]


def codes_below(codes: Codes, occupancy: NDArray[np.uint8]) -> Codes:
    """The codes of the next level, from a level's codes and bytes."""
    node, child = np.nonzero(np.unpackbits(occupancy[:, None], axis=1, bitorder="little"))
    return codes[node] << 3 | child


def codes_from_bytes(data: bytes, depth: int, cells: int) -> Codes:
    """The codes of `cells` cells from the bytes of all levels. Raises DecodeError."""
    codes, position, nodes = np.zeros(1, np.int64), 0, np.frombuffer(data, np.uint8)
    for level in range(depth):
        occupancy = nodes[position : position + len(codes)]
        if len(occupancy) < len(codes) or not occupancy.all():
            raise DecodeError(f"level {level} of the octree lacks nodes, or a node there has no child")
        position += len(codes)
        children = int(np.bitwise_count(occupancy).sum())
        if children > cells:
            raise DecodeError(f"level {level} of the octree has {children} children of {cells} cells")
        codes = codes_below(codes, occupancy)
    if position != len(data) or len(codes) != cells:
        raise DecodeError(f"the octree has {len(codes)} cells of {cells}, in {position} of {len(data)} bytes")
    return codes


def _spread(indices: NDArray[np.int64]) -> NDArray[np.int64]:
    """The bits of each index, two zeros between any two."""
    spread = indices & _ALL_BITS
    for shift, mask in _SPREADS:
        spread = (spread | spread << shift) & mask
    return spread


def _gathered(codes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Every third bit of each code, from the lowest."""
    gathered = codes & _SPREADS[-1][1]
    narrower = [mask for _, mask in _SPREADS[-2::-1]] + [_ALL_BITS]
    for (shift, _), mask in zip(reversed(_SPREADS), narrower, strict=True):
        gathered = (gathered | gathered >> shift) & mask
    return gathered

"""An octree's nodes under context mixing: each child from the nodes about it, as far as they are known.

Level by level, nodes in the order of their codes. A level's nodes are all known when their children are
coded, and so are the children of those before. Two kinds of contexts: which neighbours there are and
which of their children touch this one, in the spirit of MPEG's G-PCC (ISO/IEC 23090-9); and, for clouds
finer than they are dense, where a surface through the nodes farther about would pass.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .binary_coder import check_end, decoder, encoded_bytes, encoder
from .compiled import Ints, compiled, ints
from .errors import DecodeError
from .mixer import Mixer, code_decision, fresh_mixer
from .neighbours import ITSELF, NEAREST_FIRST, NEIGHBOURS, find_neighbours, hash_table
from .occupancy import Codes, cells_of, codes_below

MAX_NODES = 150_000  # 0.4 s
INPUTS = 7
_SLOT_BITS = 16
_LEVEL_KINDS = 4  # levels are told apart by how far they are from the leaves: 0, 1, 2, more
_OUTWARD_AXES = (1, 2, 4, 3, 5, 6, 7)  # to the neighbours that touch a child: faces x, y, z, edges, corner
_BYTES_A_NODE = 2  # and less: at 10 bits, the finest that pays, it is 0.4
_MOST_SEEN = 64  # nodes that a surface is made from
_FAR_BITS = 6  # of a code, two levels
_UNKNOWN_SPREAD = 99
_NEAR = 16  # quarters of an edge, squared: nodes closer than that count alike


def _outward() -> list[int]:
    """For each child, which of the 27 neighbours of its node touch it, in the order of _OUTWARD_AXES."""
    steps = (1, 3, 9)
    return [
        ITSELF + sum((1 if child >> axis & 1 else -1) * steps[axis] for axis in range(3) if axes >> axis & 1)
        for child in range(8)
        for axes in _OUTWARD_AXES
    ]


def _touching() -> NDArray[np.int64]:
    """How closely a neighbour's children touch a child: (child, neighbour, byte).

    Neighbours as in _OUTWARD_AXES, then the node itself; a shared face counts 3, an edge 2, a corner 1.
    """
    weights = np.zeros((8, 8, 8), np.int64)
    for child in range(8):
        for place, axes in enumerate((*_OUTWARD_AXES, 0)):
            for other in range(8):
                apart = child ^ other
                if apart & axes == axes and (axes or apart):
                    weights[child, place, other] = 4 - axes.bit_count() - (apart & ~axes).bit_count()
    bits = np.unpackbits(np.arange(256, dtype=np.uint8)[None], axis=0, bitorder="little")
    return weights @ bits


def _leaning() -> list[int]:
    """Where a byte's children lie along x, then y, then z: -1 low, 1 high, 0 on both sides."""
    highs = (0b10101010, 0b11001100, 0b11110000)
    return [bool(byte & high) - bool(byte & ~high & 255) for high in highs for byte in range(256)]


_OUTWARD, _TOUCHING, _LEANING = ints(_outward()), ints(_touching()), ints(_leaning())


class Model(NamedTuple):
    """A mixer, the tables above, and what is about the node that is coded."""

    mixer: Mixer
    outward: Ints
    touching: Ints
    leaning: Ints
    nearest_first: Ints
    neighbours: Ints  # the 27 about the node, as places in their level; -1 if there is none
    far: Ints  # the 27 about its ancestor, likewise
    means: Ints  # where nodes about lie along x, y, z, in eighths of the node's edge from its centre
    spreads: Ints  # and how far from it, on average


class Level(NamedTuple):
    """One level's nodes in the order of their codes."""

    codes: Ints
    cells: Ints  # x, y, z of each
    occupancy: Ints  # what is written or read
    keys: Ints  # a hash table of the codes, -1 where it is empty
    places: Ints  # and where in the level they are
    far_keys: Ints  # the same of the codes two levels up
    far_places: Ints
    ends: Ints  # per node two levels up, its first node here, and one behind its last
    kind: int


def encode_occupancy(levels: list[NDArray[np.uint8]]) -> bytes | None:
    """The bytes of all levels, root first; None where decoding would take too long or too many bytes."""
    nodes = sum(map(len, levels))
    if nodes > MAX_NODES:
        return None
    coder, data = encoder(nodes * _BYTES_A_NODE + 64)
    model, codes = _fresh_model(coder, data), np.zeros(1, np.int64)
    for number, occupancy in enumerate(levels):
        _code_level(model, _level(codes, ints(occupancy), len(levels) - 1 - number))
        codes = codes_below(codes, occupancy)
    try:
        return encoded_bytes(coder, data)
    except OverflowError:
        return None


def decode_occupancy(data: bytes, depth: int, cells: int) -> Codes:
    """The codes of `cells` cells from the coded bytes of `depth` levels. Raises DecodeError."""
    coder, octets = decoder(data)
    model, codes, nodes = _fresh_model(coder, octets), np.zeros(1, np.int64), 0
    for number in range(depth):
        nodes += len(codes)
        if len(codes) > cells or nodes > MAX_NODES:
            raise DecodeError(f"the octree has {nodes} nodes by level {number}, for {cells} cells")
        coded = ints(np.zeros(len(codes)))
        _code_level(model, _level(codes, coded, depth - 1 - number))
        codes = codes_below(codes, np.array(coded, np.uint8))
    check_end(coder, octets)
    if len(codes) != cells:
        raise DecodeError(f"the octree has {len(codes)} cells of {cells}")
    return codes


def _fresh_model(coder: Ints, data: NDArray[np.uint8]) -> Model:
    mixer = fresh_mixer(coder, data, INPUTS, _LEVEL_KINDS * 8, _SLOT_BITS)
    about = [ints([0] * size) for size in (27, 27, 3, 3)]
    return Model(mixer, _OUTWARD, _TOUCHING, _LEANING, NEAREST_FIRST, *about)


def _level(codes: Codes, occupancy: Ints, to_leaves: int) -> Level:
    far = np.unique(codes >> _FAR_BITS)
    ends = np.searchsorted(codes, np.stack([far, far + 1], axis=1) << _FAR_BITS)
    kind = min(to_leaves, _LEVEL_KINDS - 1)
    tables = (*hash_table(codes), *hash_table(far))
    return Level(ints(codes), ints(cells_of(codes)), occupancy, *tables, ints(ends), kind)


@compiled
def _code_level(model: Model, level: Level) -> None:
    """Write or read the bytes of one level's nodes."""
    far_code = -1
    for node in range(len(level.codes)):
        code = level.codes[node]
        find_neighbours(model.neighbours, level.keys, level.places, code)
        if code >> _FAR_BITS != far_code:
            far_code = code >> _FAR_BITS
            find_neighbours(model.far, level.far_keys, level.far_places, far_code)
        _find_surface(model, level, node)
        coded = 0
        for child in range(8):
            bit = level.occupancy[node] >> child & 1
            if child == 7 and coded == 0:
                bit = 1  # a node has a child: nothing to code
            else:
                _set_contexts(model, level, node, child, coded)
                bit = code_decision(model.mixer, bit, model.mixer.contexts, level.kind * 8 + child)
            coded |= bit << child
        level.occupancy[node] = coded


@compiled
def _find_surface(model: Model, level: Level, node: int) -> None:
    """Set the model's means and spreads: where the nodes about lie, the nearer the heavier.

    Nodes that are coded lie where their children are, others in their middle.
    """
    weights = seen = 0
    means, spreads, leaning = model.means, model.spreads, model.leaning
    cells, occupancy = level.cells, level.occupancy
    for axis in range(3):
        means[axis] = spreads[axis] = 0
    for i in range(NEIGHBOURS):
        far = model.far[model.nearest_first[i]]
        if far < 0 or seen >= _MOST_SEEN:
            continue
        last = min(level.ends[2 * far + 1], level.ends[2 * far] + _MOST_SEEN - seen)
        seen += last - level.ends[2 * far]
        for other in range(level.ends[2 * far], last):
            if other == node:
                continue
            byte = occupancy[other] if other < node else 0  # which leans to no side
            x = 4 * (cells[3 * other] - cells[3 * node]) + leaning[byte]
            y = 4 * (cells[3 * other + 1] - cells[3 * node + 1]) + leaning[256 + byte]
            z = 4 * (cells[3 * other + 2] - cells[3 * node + 2]) + leaning[512 + byte]
            weight = 65536 // (_NEAR + x * x + y * y + z * z)
            weights += weight
            means[0] += weight * x
            means[1] += weight * y
            means[2] += weight * z
            spreads[0] += weight * abs(x)
            spreads[1] += weight * abs(y)
            spreads[2] += weight * abs(z)
    for axis in range(3):
        means[axis] = 2 * means[axis] // weights if weights else 0
        spreads[axis] = 2 * spreads[axis] // weights if weights else _UNKNOWN_SPREAD


@compiled
def _set_contexts(model: Model, level: Level, node: int, child: int, coded: int) -> None:
    """What is known about a child of a node of which the children `coded` are there so far."""
    contexts, kind = model.mixer.contexts, level.kind
    touching = model.touching[(child * 8 + 7) * 256 + coded]
    there = 0  # which of the seven neighbours that touch the child there are
    to_come = 0  # how many of them are not coded yet
    faces = 0  # of the three across a face: 0 none, 3 not coded yet, else whether the cell across is empty
    for place in range(7):
        other = model.neighbours[model.outward[child * 7 + place]]
        state = 0
        if other >= node:
            to_come += 1
            state = 3
        elif other >= 0:
            byte = level.occupancy[other]
            touching += model.touching[(child * 8 + place) * 256 + byte]
            state = 1 + (byte >> (child ^ (1 << place)) & 1) if place < 3 else 1
        if state:
            there |= 1 << place
        if place < 3:
            faces = faces * 4 + state
    so_far = 0
    for earlier in range(child):
        so_far += coded >> earlier & 1
    tree = coded | 1 << child  # the children so far, ended by a one
    contexts[0] = tree * 64 + _six_faces(model)
    contexts[1] = (there * 256 + tree) * 2 + (1 if kind == 0 else 0)
    contexts[2] = faces * 256 + tree
    contexts[3] = ((min(touching, 40) * 8 + to_come) * 8 + so_far) * 8 + child
    contexts[4] = (faces * 64 + min(touching, 63)) * 4 + kind
    _set_surface_contexts(model, child, so_far, kind)


@compiled
def _six_faces(model: Model) -> int:
    """Which of the node's six face neighbours there are."""
    faces, step = 0, 1
    for axis in range(3):
        faces |= (1 if model.neighbours[ITSELF - step] >= 0 else 0) << 2 * axis
        faces |= (1 if model.neighbours[ITSELF + step] >= 0 else 0) << 2 * axis + 1
        step *= 3
    return faces


@compiled
def _set_surface_contexts(model: Model, child: int, so_far: int, kind: int) -> None:
    """Where the nodes about lie, and how far along the axis that they scatter least about."""
    means, spreads, contexts = model.means, model.spreads, model.mixer.contexts
    flattest, lean = 0, 0
    for axis in range(3):
        lean = lean * 5 + min(max(means[axis], -2), 2) + 2
        if spreads[axis] < spreads[flattest]:
            flattest = axis
    offset = min(max(means[flattest], -8), 8) + 8
    contexts[5] = ((lean * 8 + child) * 2 + (1 if so_far else 0)) * 2 + (1 if kind == 0 else 0)
    contexts[6] = (((flattest * 16 + min(spreads[flattest], 15)) * 17 + offset) * 8 + child) * 4 + min(
        so_far, 3
    )

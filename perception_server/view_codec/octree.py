"""Occupied space as the leaves of an octree, each a cube of a given edge on one fixed grid."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .cell_set import decode_cells, encode_cells
from .codec_id import CodecId, codec_of, wished_codec
from .errors import DecodeError, EncodeError
from .finite_points import finite_points
from .occupancy import MAX_DEPTH, Cells

MAX_KEY = (1 << 30) - 1
MAX_LEAF_M = 1e20
_GRID = struct.Struct("<d3i")  # leaf edge in metres; smallest key along x, y, z
_CODECS = {"zstd": CodecId.OCTREE_ZSTD, "context": CodecId.OCTREE_CONTEXT}


@dataclass(frozen=True, slots=True, eq=False)
class OctreeView:
    """A decoded octree.

    keys: (N, 3) int64; leaf k spans k * leaf_m to (k + 1) * leaf_m along each axis, as in OctoMap.
    leaf_m: edge of a leaf.
    """

    keys: NDArray[np.int64]
    leaf_m: float

    @property
    def centres(self) -> NDArray[np.float32]:
        """The middle of each leaf, (N, 3) metres in the frame of whoever encoded them."""
        return ((self.keys + 0.5) * self.leaf_m).astype(np.float32)


def encode_octree(points: ArrayLike, *, leaf_m: float, codec: CodecId | str | None = None) -> bytes:
    """One message with the leaves that hold a point, which `decode_octree` reads.

    points: (N, 3) metres in any frame, N from 0; rows that are not finite are left out.
    leaf_m: edge of a leaf, whose grid passes through the frame's origin.
    codec: "zstd" (fast), "context" (small); None for the smaller.
    Raises EncodeError for more than 2**20 leaves along an axis, more than 2**19 in all, and for points
    farther than 2**30 leaves from the origin.
    """
    codec = wished_codec(codec, _CODECS)
    if not 0 < leaf_m <= MAX_LEAF_M:
        raise EncodeError(f"leaf_m = {leaf_m} is outside 0..{MAX_LEAF_M:g} m")
    known = finite_points(points)
    farthest_m = float(np.abs(known).max(initial=0.0))
    if farthest_m / leaf_m >= MAX_KEY:
        raise EncodeError(f"a point at {farthest_m:g} m is above {MAX_KEY} leaves of {leaf_m} m away")
    keys = _keys_of(known, leaf_m)
    first = keys.min(axis=0) if len(keys) else np.zeros(3, np.int64)
    cells: Cells = keys - first
    if cells.max(initial=0) >= 1 << MAX_DEPTH:
        raise EncodeError(
            f"{cells.max() + 1} leaves along an axis are above {1 << MAX_DEPTH}: take larger ones"
        )
    header = _GRID.pack(leaf_m, *map(int, first))
    return encode_cells(cells, CodecId.OCTREE_ZSTD, CodecId.OCTREE_CONTEXT, header, codec)


def decode_octree(data: bytes) -> OctreeView:
    """The leaves of a message from `encode_octree`. Raises DecodeError."""
    data = bytes(data)
    codec = codec_of(data)
    if codec not in _CODECS.values():
        raise DecodeError(f"a view of codec {codec.name} is no octree")
    if len(data) < 1 + _GRID.size:
        raise DecodeError(f"an octree of {len(data)} bytes lacks its grid of {_GRID.size} bytes")
    leaf_m, *first = _GRID.unpack_from(data, 1)
    if not 0 < leaf_m <= MAX_LEAF_M:
        raise DecodeError(f"a leaf of {leaf_m} m is outside 0..{MAX_LEAF_M:g} m")
    cells = decode_cells(data[1 + _GRID.size :], codec is CodecId.OCTREE_CONTEXT)
    return OctreeView(cells + np.array(first, np.int64), leaf_m)


def _keys_of(points: NDArray[np.float64], leaf_m: float) -> NDArray[np.int64]:
    """The leaf of each point, (N, 3); exact also where the division rounds across a border."""
    keys = np.floor(points / leaf_m)
    keys -= keys * leaf_m > points
    keys += (keys + 1) * leaf_m <= points
    return keys.astype(np.int64)

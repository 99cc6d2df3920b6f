"""Point clouds within a declared error: a cubic lattice, its occupied cells, and an octree of those.

Points that share a cell become one, and their order is lost; what is not finite has no place and is
left out. The paper's own encoding (x, y, z of every point, zlib) keeps both and is here for comparison.
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .cell_set import decode_cells, encode_cells
from .codec_id import CodecId, codec_of, wished_codec
from .errors import DecodeError, EncodeError
from .finite_points import finite_points
from .occupancy import MAX_CELLS, MAX_DEPTH, Cells
from .own_lattice import own_step_m, slack_m

Points = NDArray[np.float32]
_LATTICE = struct.Struct("<3fff")  # origin x, y, z; step; achieved maximum error: metres
_COUNTED = struct.Struct("<BI")  # of the zlib codec: bytes an axis; points
_WIDTHS = (1, 2, 4)
_LEAST_STEP_M = float(np.finfo(np.float32).tiny)
_ROUNDING = 1 - 2.0**-20  # room for a step's rounding to 32 bits
_CODECS = {"zlib": CodecId.CLOUD_ZLIB, "zstd": CodecId.CLOUD_ZSTD, "context": CodecId.CLOUD_CONTEXT}


@dataclass(frozen=True, slots=True, eq=False)
class CloudView:
    """A decoded cloud.

    points: (N, 3) float32 metres in the frame of whoever encoded them; no point twice unless the
        codec is CLOUD_ZLIB.
    step_m: edge of a lattice cell; 0 where all points were one.
    max_error_m: how far the farthest source point is from its decoded one.
    """

    points: Points
    step_m: float
    max_error_m: float


@dataclass(frozen=True, slots=True)
class Lattice:
    """Cells of a cube; the centre of cell 0, 0, 0 is the origin."""

    origin_m: NDArray[np.float64]  # (3,), each a float32
    step_m: float  # a float32

    def cells_of(self, points: NDArray[np.float64]) -> Cells:
        """The cell of each point, (N, 3)."""
        step_m = self.step_m or 1.0
        return np.rint((points - self.origin_m) / step_m).astype(np.int64)

    def points_of(self, cells: Cells) -> Points:
        """The centres of cells, (N, 3) metres."""
        return (self.origin_m + cells * self.step_m).astype(np.float32)


def encode_cloud(
    points: ArrayLike,
    *,
    bits: int | None = None,
    max_error_m: float | None = None,
    codec: CodecId | str | None = None,
) -> bytes:
    """One message for a cloud, which `decode_cloud` reads.

    points: (N, 3) metres in any frame, N from 0; rows that are not finite are left out.
    bits: per axis, 1..20, over the longest side of the cloud's box; or
    max_error_m: no point moves by more than this, measured straight through the three axes.
    Points that lie on a coarser lattice than that already, such as centres of voxels, are coded on it.
    codec: "zlib" (the paper's), "zstd" (fast), "context" (small); None for the smaller of the latter.
    Raises EncodeError for what cannot be held: coordinates above 1e30 m, more than 2**20 cells along
    an axis, more than 2**19 cells in all, an error below the rounding of float32 at such coordinates.
    """
    codec = wished_codec(codec, _CODECS)
    known = finite_points(points)
    lattice = _lattice(known, bits, max_error_m)
    if codec is not CodecId.CLOUD_ZLIB:
        lattice = _own_lattice(known, lattice) or lattice
    cells = lattice.cells_of(known)
    achieved_m = _farthest_m(known, lattice.points_of(cells))
    header = _LATTICE.pack(*lattice.origin_m, lattice.step_m, achieved_m)
    if codec is CodecId.CLOUD_ZLIB:
        return bytes([codec]) + header + _zlib_coded(cells)
    return encode_cells(cells, CodecId.CLOUD_ZSTD, CodecId.CLOUD_CONTEXT, header, codec)


def decode_cloud(data: bytes) -> CloudView:
    """The cloud of a message from `encode_cloud`. Raises DecodeError."""
    data = bytes(data)
    codec = codec_of(data)
    if codec not in _CODECS.values():
        raise DecodeError(f"a view of codec {codec.name} is no cloud")
    lattice, max_error_m = unpack_lattice(data)
    coded = data[1 + _LATTICE.size :]
    mixed = codec is CodecId.CLOUD_CONTEXT
    cells = _zlib_decoded(coded) if codec is CodecId.CLOUD_ZLIB else decode_cells(coded, mixed)
    with np.errstate(over="ignore"):
        points = lattice.points_of(cells)
    if not np.isfinite(points).all():
        raise DecodeError(
            f"a lattice from {lattice.origin_m} m with steps of {lattice.step_m} m leaves float32"
        )
    return CloudView(points, lattice.step_m, max_error_m)


def unpack_lattice(data: bytes) -> tuple[Lattice, float]:
    """Where a message's cells lie, and its max_error_m, without reading the cells. Raises DecodeError."""
    if len(data) < 1 + _LATTICE.size:
        raise DecodeError(f"a cloud of {len(data)} bytes lacks its lattice of {_LATTICE.size} bytes")
    *origin_m, step_m, max_error_m = _LATTICE.unpack_from(data, 1)
    if not all(map(math.isfinite, (*origin_m, step_m, max_error_m))) or step_m < 0 or max_error_m < 0:
        raise DecodeError(f"a lattice from {origin_m} m with steps of {step_m} m is unsound")
    return Lattice(np.array(origin_m), step_m), max_error_m


def _lattice(points: NDArray[np.float64], bits: int | None, max_error_m: float | None) -> Lattice:
    """The coarsest lattice that keeps the promise."""
    _check_wish(bits, max_error_m)
    if len(points) == 0:
        return Lattice(np.zeros(3), 0.0)
    origin_m = _rounded_down(points.min(axis=0))
    extent_m = float((points.max(axis=0) - origin_m).max())
    if bits is not None:
        step_m = extent_m / ((1 << bits) - 1)
    else:
        assert max_error_m is not None
        step_m = _step_within(max_error_m, float(np.abs(points).max()))
        if extent_m / step_m > (1 << MAX_DEPTH) - 1:
            raise EncodeError(
                f"max_error_m = {max_error_m} over {extent_m:g} m needs more than {MAX_DEPTH} bits per axis"
            )
    return Lattice(origin_m, float(np.float32(step_m)) if step_m > _LEAST_STEP_M else 0.0)


def _own_lattice(points: NDArray[np.float64], wished: Lattice) -> Lattice | None:
    """The lattice of the points themselves, if it is coarser than the wished one and moves none of them."""
    step_m = own_step_m(points, wished.step_m) if wished.step_m else None
    if step_m is None:
        return None
    own = Lattice(wished.origin_m, float(np.float32(step_m)))
    return own if _farthest_m(points, own.points_of(own.cells_of(points))) <= slack_m(points) else None


def _check_wish(bits: int | None, max_error_m: float | None) -> None:
    if (bits is None) == (max_error_m is None):
        raise EncodeError(f"bits = {bits} and max_error_m = {max_error_m}: exactly one must be given")
    if bits is not None and bits not in range(1, MAX_DEPTH + 1):
        raise EncodeError(f"bits = {bits} is outside 1..{MAX_DEPTH}")
    if max_error_m is not None and not 0 < max_error_m < math.inf:
        raise EncodeError(f"max_error_m = {max_error_m} must be above 0 and finite")


def _step_within(max_error_m: float, largest_m: float) -> float:
    """The step whose cells' corners are max_error_m from their centre, both rounded to 32 bits."""
    rounding_m = math.sqrt(3) / 2 * float(np.spacing(np.float32(largest_m + max_error_m)))
    if rounding_m >= max_error_m:
        raise EncodeError(
            f"max_error_m = {max_error_m} cannot be held: float32 itself moves points at {largest_m:g} m "
            f"by up to {rounding_m:.2g} m"
        )
    return 2 / math.sqrt(3) * (max_error_m - rounding_m) * _ROUNDING


def _rounded_down(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The nearest float32 numbers that are not above the values."""
    rounded = values.astype(np.float32)
    return np.where(rounded > values, np.nextafter(rounded, np.float32(-np.inf)), rounded).astype(np.float64)


def _farthest_m(points: NDArray[np.float64], decoded: Points) -> float:
    """The largest distance between points and what became of them, rounded up to a float32."""
    squares = ((points - decoded) ** 2).sum(axis=1)
    farthest_m = np.sqrt(squares.max(initial=0.0))
    rounded = np.float32(farthest_m)
    return float(np.nextafter(rounded, np.float32(np.inf)) if rounded < farthest_m else rounded)


def _zlib_coded(cells: Cells) -> bytes:
    """As the paper: x, y, z of each point in 8, 16 or 32 bits, zlib level 9."""
    if len(cells) > MAX_CELLS:
        raise EncodeError(f"{len(cells)} points are above {MAX_CELLS}: crop, or thin them out")
    width = next(width for width in _WIDTHS if cells.max(initial=0) < 1 << 8 * width)
    return _COUNTED.pack(width, len(cells)) + zlib.compress(cells.astype(f"<u{width}").tobytes(), 9)


def _zlib_decoded(data: bytes) -> Cells:
    if len(data) < _COUNTED.size:
        raise DecodeError(f"a cloud's {len(data)} bytes lack its size of {_COUNTED.size} bytes")
    width, count = _COUNTED.unpack_from(data)
    if width not in _WIDTHS or count > MAX_CELLS:
        raise DecodeError(f"a cloud of {count} points of {width} bytes an axis is unknown")
    reader, size = zlib.decompressobj(), 3 * width * count
    try:
        content = reader.decompress(data[_COUNTED.size :], size + 1)
    except zlib.error as error:
        raise DecodeError(f"the zlib stream is unsound: {error}") from None
    if len(content) != size or not reader.eof or reader.unused_data:
        raise DecodeError(f"the zlib stream does not hold exactly {count} points")
    return np.frombuffer(content, f"<u{width}").astype(np.int64).reshape(-1, 3)

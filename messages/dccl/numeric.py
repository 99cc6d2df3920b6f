"""Bounded numbers: how many bits, and which integer stands for which value.

The arithmetic is that of DCCL 2 to 4, in its order of IEEE operations, rounding bugs included: a width
or a halfway case that differs by one bit makes two implementations deaf to each other.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from typing import Literal

import numpy as np
from google.protobuf.descriptor import FieldDescriptor

NumberType = Literal["double", "float", "int32", "int64", "uint32", "uint64"]

NUMBER_TYPES: dict[int, NumberType] = {
    FieldDescriptor.CPPTYPE_DOUBLE: "double",
    FieldDescriptor.CPPTYPE_FLOAT: "float",
    FieldDescriptor.CPPTYPE_INT32: "int32",
    FieldDescriptor.CPPTYPE_INT64: "int64",
    FieldDescriptor.CPPTYPE_UINT32: "uint32",
    FieldDescriptor.CPPTYPE_UINT64: "uint64",
}
_INTEGER_BITS = {"int32": 32, "uint32": 32, "int64": 64, "uint64": 64}
_FLOAT = struct.Struct("<f")
MAX_FLOAT = 3.4028234663852886e38
# Below these magnitudes of index the rounding errors of the formulas stay under half a step: relative
# errors of at most 8 * 2^-53 (double) and 4 * 2^-24 (float) times the index.
_EXACT_INDEX = {"double": 2**44, "float": 2**20}
_VERIFIED_COUNT = 2**17  # up to this many values a float field is checked one by one instead


def clog2(n: int) -> int:
    """The least b with 2^b >= n, for n >= 1."""
    return (n - 1).bit_length()


def to_float32(x: float) -> float:
    """x rounded to the nearest float32; infinite where C++ would be."""
    try:
        return float(_FLOAT.unpack(_FLOAT.pack(x))[0])
    except OverflowError:
        return math.copysign(math.inf, x)


def type_bounds(number_type: NumberType) -> tuple[float, float]:
    """The least and greatest value of a C++ type."""
    if number_type == "double":
        return -math.inf, math.inf
    if number_type == "float":
        return -MAX_FLOAT, MAX_FLOAT
    bits = _INTEGER_BITS[number_type]
    if number_type.startswith("u"):
        return 0, 2**bits - 1
    return -(2 ** (bits - 1)), 2 ** (bits - 1) - 1


@dataclass(frozen=True, slots=True)
class Numeric:
    """A bounded number on the wire.

    minimum, maximum, resolution: in the field's unit. is_required: no bit pattern stands for "unset".
    bits: width on the wire. origin: the index (value / resolution, rounded) that is sent as 0.
    lowest, highest: indices of the quantised values within the bounds. first, last: the same, and the
    bounds themselves where only rounding noise puts them outside (0.05f exceeds 0.05).
    is_affine: for every index from first to last, the wire carries index - origin and decodes to
    index * resolution, so that compiled code may say just that.
    """

    number_type: NumberType
    minimum: float
    maximum: float
    resolution: float
    is_required: bool
    bits: int
    origin: int
    lowest: int
    highest: int
    first: int
    last: int
    is_affine: bool

    @property
    def is_float(self) -> bool:
        """Whether the field is a double or a float."""
        return self.number_type in ("double", "float")

    @property
    def inverse(self) -> float:
        """1 / resolution, by which values are multiplied where the resolution is below 1."""
        return 1.0 / self.resolution

    @property
    def offset(self) -> int:
        """What is added to the wire integer so that 0 can stand for "unset"."""
        return 0 if self.is_required else 1

    @property
    def greatest_wire(self) -> int:
        """The greatest integer that an encoder sends."""
        return self.last - self.origin + self.offset

    @property
    def type_range(self) -> tuple[float, float]:
        """The bounds as values of the field's type: what somebody who sets a bound has set."""
        if self.number_type == "float":
            return to_float32(self.minimum), to_float32(self.maximum)
        return self.minimum, self.maximum

    def wire(self, value: float) -> int | None:
        """The integer on the wire; None where the value is out of range. NaN is sent as the minimum."""
        if value != value:
            return self.offset
        if math.isinf(value) or math.isinf(value * self.inverse):
            return None  # beyond all bounds before any rounding
        quantised = self._quantise(value)
        if quantised < self.minimum or quantised > self.maximum:
            return None
        distance = self._cast(quantised - self._quantised_minimum())
        scaled = distance / self.resolution if self.resolution >= 1 else distance * self.inverse
        steps = math.floor(self._cast(scaled) + 0.5) if self.is_float else int(self._cast(scaled))
        return (steps + self.offset) & ((1 << self.bits) - 1)

    def value(self, wire: int) -> float | int | None:
        """What an integer of the wire stands for: None for "unset"."""
        if not self.is_required:
            if wire == 0:
                return None
            wire -= 1
        steps = self._cast(wire)
        scaled = steps * self.resolution if self.resolution >= 1 else steps / self.inverse
        return self._quantise(self._cast(self._cast(scaled) + self._quantised_minimum()))

    def is_valid_wire(self, wire: int) -> bool:
        """Whether an encoder can have sent this integer."""
        if self.is_affine:  # the bounds themselves are sent, also where rounding noise puts them outside
            return wire < self.offset or self.first <= wire - self.offset + self.origin <= self.last
        value = self.value(wire)
        return value is None or self.minimum <= value <= self.maximum or wire == self.offset

    def clamp(self, value: float) -> int:
        """The wire integer of the nearest value in range."""
        is_low = value < (self.minimum + self.maximum) / 2
        if self.is_affine:
            return (self.first if is_low else self.last) - self.origin + self.offset
        step = self.resolution if self.is_float else max(1, math.ceil(self.resolution))
        bound = self.minimum if is_low else self.maximum
        wire = self.wire(bound)
        if wire is None:
            wire = self.wire(bound + step if is_low else bound - step)
        return self.offset if wire is None else wire

    def _quantised_minimum(self) -> float:
        return self._quantise(self._cast(self.minimum))

    def _quantise(self, value: float) -> float:
        if self.is_float:
            return self._cast(_float_at(_float_index(value, self.resolution), self.resolution))
        if self.resolution % 1 != 0:
            return value
        step = int(self.resolution)
        value = int(value)
        # C truncates towards zero: the remainder has the sign of the value.
        remainder = value % step if value >= 0 else -(-value % step)
        quantised = value - remainder
        return quantised + step if remainder >= self.resolution / 2 else quantised

    def _cast(self, value: float) -> float:
        if self.number_type == "double":
            return float(value)
        if self.number_type == "float":
            return to_float32(value)
        bits = _INTEGER_BITS[self.number_type]
        wrapped = int(value) & ((1 << bits) - 1)
        if self.number_type.startswith("u") or wrapped < 1 << (bits - 1):
            return wrapped
        return wrapped - (1 << bits)


def width(minimum: float, maximum: float, resolution: float, is_required: bool) -> int:
    """Bits of a bounded number; rounding noise can cost one, and does so in DCCL too."""
    return clog2(math.ceil((maximum - minimum) / resolution + 1 + (0 if is_required else 1)))


def make_numeric(
    number_type: NumberType, minimum: float, maximum: float, resolution: float, is_required: bool
) -> Numeric:
    """A bounded number with its width and indices; the bounds are taken as checked."""
    bits = width(minimum, maximum, resolution, is_required)
    if number_type in ("double", "float"):
        return _make_float(number_type, minimum, maximum, resolution, is_required, bits)
    origin, highest = int(minimum), math.floor(maximum)
    lowest = math.ceil(minimum)
    fits = highest - origin + (0 if is_required else 1) < 1 << bits
    return Numeric(
        number_type,
        minimum,
        maximum,
        resolution,
        is_required,
        bits,
        origin,
        lowest,
        highest,
        lowest,
        highest,
        is_affine=resolution == 1 and fits and lowest <= highest,
    )


def _make_float(
    number_type: NumberType, minimum: float, maximum: float, resolution: float, is_required: bool, bits: int
) -> Numeric:
    cast = to_float32 if number_type == "float" else float
    origin = _float_index(cast(minimum), resolution)
    lowest = _float_index(minimum, resolution) - 1
    while cast(_float_at(lowest, resolution)) < minimum:
        lowest += 1
    highest = _float_index(maximum, resolution) + 1
    while cast(_float_at(highest, resolution)) > maximum:
        highest -= 1
    room = (1 << bits) - (0 if is_required else 1)
    noise = resolution * 1e-3
    top = _float_index(maximum, resolution)
    is_top_near = abs(_float_at(top, resolution) - maximum) < noise and top - origin < room
    is_origin_near = abs(_float_at(origin, resolution) - minimum) < noise
    first = origin if is_origin_near else lowest
    last = max(top, highest) if is_top_near else highest
    # An empty range (a maximum below its own float32 rounding, with one value) has no affine form.
    is_affine = (
        lowest <= highest
        and origin <= lowest
        and last - origin < room
        and _is_affine(number_type, origin, first, last, resolution)
    )
    return Numeric(
        number_type,
        minimum,
        maximum,
        resolution,
        is_required,
        bits,
        origin,
        lowest,
        highest,
        first,
        last,
        is_affine,
    )


def _float_index(value: float, resolution: float) -> int:
    if resolution >= 1:
        return math.floor(value / resolution + 0.5)
    return math.floor(value * (1.0 / resolution) + 0.5)


def _float_at(index: int, resolution: float) -> float:
    return index * resolution if resolution >= 1 else index / (1.0 / resolution)


def _is_affine(number_type: NumberType, origin: int, lowest: int, highest: int, resolution: float) -> bool:
    """Whether index - origin is what the formulas send, and index * resolution what they decode."""
    if max(abs(origin), abs(lowest), abs(highest), highest - origin) < _EXACT_INDEX[number_type]:
        return True
    if highest - lowest > _VERIFIED_COUNT or number_type == "double":
        return False
    kind = np.float32
    inverse = 1.0 / resolution
    index = np.arange(lowest, highest + 1).astype(np.float64)
    at = index * resolution if resolution >= 1 else index / inverse
    minimum = kind(_float_at(origin, resolution))
    distance = (at.astype(kind) - minimum).astype(np.float64)
    scaled = (distance / resolution if resolution >= 1 else distance * inverse).astype(kind)
    steps = np.floor(scaled.astype(np.float64) + 0.5)
    back = (steps * resolution if resolution >= 1 else steps / inverse).astype(kind) + minimum
    back = back.astype(np.float64)
    again = np.floor((back / resolution if resolution >= 1 else back * inverse) + 0.5)
    return bool((steps == index - origin).all() and (again == index).all())

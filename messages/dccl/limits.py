"""What happens to a value that its field cannot carry: a decision of the codec's user, never implicit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from messages.dccl.errors import DecodeError, EncodeError
from messages.dccl.numeric import Numeric

Treatment = Literal["raise", "clamp", "dccl"]


@dataclass(frozen=True, slots=True)
class Deviation:
    """One value that was not sent as it was. path: from the root, as in "arm[2].angle"."""

    path: str
    value: object
    what: str


@dataclass(slots=True)
class Deviations:
    """Collects the deviations of one message."""

    found: list[Deviation]

    def add(self, path: str, value: object, what: str) -> None:
        """Note one."""
        self.found.append(Deviation(path, value, what))


class NumberLimits:
    """Bounds of one number field, with what to do beyond them.

    Called by compiled code for the values that its fast path does not take. An index is value /
    resolution; a wire integer is what is sent.
    """

    def __init__(self, path: str, numeric: Numeric, treatment: Treatment) -> None:
        self._path = path
        self._numeric = numeric
        self._treatment = treatment

    def index(self, value: float, deviations: Deviations) -> int:
        """The index to send for a value out of bounds."""
        return self.wire(value, deviations) + self._numeric.origin - self._numeric.offset

    def indices(self, values: Sequence[float], deviations: Deviations) -> list[int]:
        """The indices to send for values of which some are out of bounds."""
        shift = self._numeric.origin - self._numeric.offset
        return [wire + shift for wire in self.wires(values, deviations)]

    def wires(self, values: Sequence[float], deviations: Deviations) -> list[int]:
        """The wire integers of a repeated field."""
        path = self._path
        return [self._wire(v, self._numeric, f"{path}[{i}]", deviations) for i, v in enumerate(values)]

    def wire(self, value: float, deviations: Deviations) -> int:
        """The wire integer of a value."""
        return self._wire(value, self._numeric, self._path, deviations)

    def wire_within(self, numeric: Numeric, value: float, deviations: Deviations) -> int:
        """The wire integer of a value whose bounds a dynamic condition has set."""
        return self._wire(value, numeric, self._path, deviations)

    def value(self, wire: int) -> float | None:
        """The value of a wire integer; DecodeError where no encoder can have sent it."""
        return self.value_within(self._numeric, wire)

    def value_within(self, numeric: Numeric, wire: int) -> float | None:
        """The same with bounds that a dynamic condition has set."""
        if not numeric.is_valid_wire(wire):
            raise self.beyond(wire)
        return numeric.value(wire)

    def beyond(self, wire: int) -> DecodeError:
        """The error for a wire integer that stands for a value out of bounds."""
        n = self._numeric
        return DecodeError(
            f"{self._path}: {wire} on the wire is beyond its bounds {n.minimum:g} to {n.maximum:g}"
        )

    def beyond_value(self, value: float) -> DecodeError:
        """The error for an element of a repeated field that is out of bounds."""
        n = self._numeric
        return DecodeError(f"{self._path}: {value} is beyond its bounds {n.minimum:g} to {n.maximum:g}")

    def _wire(self, value: float, numeric: Numeric, path: str, deviations: Deviations) -> int:
        is_nan = value != value
        wire = None if is_nan else numeric.wire(value)
        if wire is not None:
            return wire
        low, high = numeric.type_range
        if self._treatment != "dccl" and low <= value <= high:
            # Rounding has put it outside: a bound of which DCCL says that it exceeds itself.
            deviations.add(path, value, "rounded to its nearest bound")
            return numeric.clamp(value)
        if self._treatment == "raise":
            bounds = f"{numeric.minimum:.10g} to {numeric.maximum:.10g}"
            raise EncodeError(f"{path} = {value:.7g} is not a value within its bounds {bounds}")
        if self._treatment == "clamp":
            if is_nan:
                raise EncodeError(f"{path} is not a number; there is no bound to clamp it to")
            deviations.add(path, value, "clamped to its nearest bound")
            return numeric.clamp(value)
        if is_nan:
            deviations.add(path, value, "sent as the minimum")
            return numeric.offset
        deviations.add(path, value, "sent as the minimum" if numeric.is_required else "sent as unset")
        return 0


class TextLimits:
    """The greatest length of one string or bytes field, with what to do beyond it."""

    def __init__(self, path: str, max_length: int, is_strict: bool) -> None:
        self._path = path
        self._max_length = max_length
        self._is_strict = is_strict

    def cut(self, content: bytes, deviations: Deviations) -> bytes:
        """A content that is too long, cut; it may be cut within a character, as DCCL's is."""
        if self._is_strict:
            raise EncodeError(
                f"{self._path} is {len(content)} bytes long; its max_length is {self._max_length}"
            )
        deviations.add(self._path, content, f"cut to {self._max_length} bytes")
        return content[: self._max_length]

    def text(self, content: bytes) -> str:
        """The string of its UTF-8; DecodeError where it is none. A character cut by DCCL is left out."""
        try:
            return content.decode()
        except UnicodeDecodeError as error:
            if error.reason == "unexpected end of data" and len(content) == self._max_length:
                return content[: error.start].decode()
            raise DecodeError(f"{self._path}: its {len(content)} bytes are not UTF-8") from error

    def too_long(self, length: int) -> DecodeError:
        """The error for a length prefix beyond max_length."""
        return DecodeError(f"{self._path}: a length of {length} exceeds its max_length {self._max_length}")


class CountLimits:
    """The bounds of a repeated field's length, with what to do beyond them."""

    def __init__(self, path: str, low: int, high: int, is_strict: bool) -> None:
        self._path = path
        self._low = low
        self._high = high
        self._is_strict = is_strict

    def fit(self, values: Sequence[Any], deviations: Deviations) -> Sequence[Any]:
        """Too many elements cut; too few as they are, to be filled up with zero bits."""
        count = len(values)
        if self._is_strict:
            bounds = f"{self._low} to {self._high}"
            raise EncodeError(f"{self._path} has {count} elements; its bounds are {bounds}")
        if count > self._high:
            deviations.add(self._path, count, f"cut to max_repeat = {self._high} elements")
            return values[: self._high]
        deviations.add(self._path, count, f"filled up to min_repeat = {self._low} elements")
        return values

    def too_many(self, count: int) -> DecodeError:
        """The error for a count beyond max_repeat."""
        return DecodeError(f"{self._path}: a count of {count} exceeds its max_repeat {self._high}")


class RequiredLimits:
    """A field that a dynamic condition requires and the message leaves unset."""

    def __init__(self, path: str, is_strict: bool) -> None:
        self._path = path
        self._is_strict = is_strict

    def missing(self, deviations: Deviations) -> None:
        """Raise, or note that zero bits are sent, which stand for the minimum or an empty content."""
        if self._is_strict:
            raise EncodeError(f"{self._path} is unset, and a dynamic condition requires it")
        deviations.add(self._path, None, "unset though required: sent as zero bits")


def careful_fmod(x: float, y: float) -> float:
    """fmod that lets infinities through to the check of the bounds."""
    return math.fmod(x, y) if math.isfinite(x) else x


def careful_floor(x: float) -> int:
    """floor, with an integer beyond all bounds for NaN and infinities."""
    return math.floor(x) if math.isfinite(x) else 1 << 1100

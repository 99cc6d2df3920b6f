"""A time modulo a window: the receiver's clock, passed in, tells which of the windows is meant."""

from __future__ import annotations

from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any

from messages.dccl.custom import BoundEncoder
from messages.dccl.errors import DecodeError, EncodeError
from messages.dccl.limits import Deviations, Treatment
from messages.dccl.numeric import clog2

_NS_PER_S = 1_000_000_000
_MAX_TIME_S = 2**40  # 34,000 years: beyond it a time is a mistake


@dataclass(frozen=True, slots=True)
class Moment:
    """A Unix time in steps of `resolution`, of which the wire carries the number modulo `count`.

    resolution: in the field's unit, of which there are per_second in a second. greatest: of the type.
    """

    name: str
    resolution: Fraction
    count: int
    per_second: int
    is_integer: bool
    least: int
    greatest: int
    is_required: bool
    min_bits: int = field(init=False, repr=False)
    max_bits: int = field(init=False, repr=False)

    def __post_init__(self) -> None:
        bits = clog2(self.count + self.offset)
        object.__setattr__(self, "min_bits", bits)
        object.__setattr__(self, "max_bits", bits)

    @property
    def offset(self) -> int:
        """1 where 0 stands for "unset"."""
        return 0 if self.is_required else 1

    @property
    def shown(self) -> tuple[float, float, float] | None:
        """Nothing, the window and the resolution in the field's unit, for tables."""
        return 0.0, float(self.resolution * self.count), float(self.resolution)

    def residue(self, path: str, time: float) -> int:
        """The number of a time's step within the window; EncodeError for what is no time."""
        if not abs(time) <= _MAX_TIME_S * self.per_second:
            raise EncodeError(f"{path} = {time:.7g} is not a time")
        numerator, denominator = time.as_integer_ratio()
        # floor(time / resolution + 1/2), in integers
        above = 2 * numerator * self.resolution.denominator + denominator * self.resolution.numerator
        return above // (2 * denominator * self.resolution.numerator) % self.count

    def time(self, residue: int, now_ns: int | None) -> float | int:
        """The time nearest to now that has the residue."""
        if now_ns is None:
            raise DecodeError(f"{self.name} is a time: decoding it needs now_ns, the receiver's clock")
        step_ns = self.resolution * _NS_PER_S / self.per_second
        now = now_ns * step_ns.denominator // step_ns.numerator
        distance = (residue - now) % self.count
        exact = (now + distance - (self.count if 2 * distance > self.count else 0)) * self.resolution
        time = int(exact) if self.is_integer else float(exact)
        if not self.least <= time <= self.greatest:
            raise DecodeError(f"{self.name}: {time} is not a time that the field can hold")
        return time

    def encoder(self, path: str, treatment: Treatment, is_strict: bool) -> BoundEncoder:
        """The encoder of the field at a path."""

        def encode(value: Any, deviations: Deviations) -> tuple[int, int]:
            return (0 if value is None else self.residue(path, value) + self.offset), self.max_bits

        return encode

    def decode(self, bits: int, available: int, now_ns: int | None) -> tuple[float | int | None, int]:
        """The time at the low end of `bits`."""
        residue = (bits & (1 << self.max_bits) - 1) - self.offset
        if residue >= self.count:
            raise DecodeError(f"{self.name}: step {residue} is beyond its window of {self.count}")
        return (None if residue < 0 else self.time(residue, now_ns)), self.max_bits

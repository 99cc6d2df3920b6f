"""Bounded numbers on exact steps: one by one, or a list that shares its bounds and is packed as one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from messages.dccl.custom import BoundEncoder
from messages.dccl.errors import DecodeError
from messages.dccl.limits import CountLimits, Deviations, Treatment
from messages.dccl.numeric import clog2
from messages.dccl.straitlink.limits import StepLimits
from messages.dccl.straitlink.radix import join, power, split
from messages.dccl.straitlink.steps import Steps


@dataclass(frozen=True, slots=True)
class Range:
    """A field's steps and its bounds as values of its type. The base of what follows."""

    name: str
    steps: Steps
    low: float
    high: float

    @property
    def shown(self) -> tuple[float, float, float]:
        """Minimum, maximum and resolution, for tables."""
        s = self.steps
        return float(s.minimum), float(s.maximum), float(s.resolution)

    def limits(self, path: str, treatment: Treatment, offset: int = 0) -> StepLimits:
        """The range with what to do beyond it."""
        return StepLimits(path, self.steps, self.low, self.high, treatment, offset)


@dataclass(frozen=True, slots=True)
class SteppedNumber:
    """One number: its step; or, where it may be unset, 0 for that and the step plus 1."""

    range: Range
    is_required: bool
    min_bits: int = field(init=False, repr=False)
    max_bits: int = field(init=False, repr=False)

    def __post_init__(self) -> None:
        bits = clog2(self.range.steps.count + self.offset)
        object.__setattr__(self, "min_bits", bits)
        object.__setattr__(self, "max_bits", bits)

    @property
    def offset(self) -> int:
        """1 where 0 stands for "unset"."""
        return 0 if self.is_required else 1

    @property
    def shown(self) -> tuple[float, float, float] | None:
        """Minimum, maximum and resolution, for tables."""
        return self.range.shown

    def encoder(self, path: str, treatment: Treatment, is_strict: bool) -> BoundEncoder:
        """The encoder of the field at a path."""
        wire, bits = self.range.limits(path, treatment, self.offset).wire, self.max_bits

        def encode(value: Any, deviations: Deviations) -> tuple[int, int]:
            return (0 if value is None else wire(value, deviations)), bits

        return encode

    def decode(self, bits: int, available: int, now_ns: int | None) -> tuple[float | int | None, int]:
        """The number at the low end of `bits`."""
        step = (bits & (1 << self.max_bits) - 1) - self.offset
        if step >= self.range.steps.count:
            raise DecodeError(f"{self.range.name}: step {step} is beyond its {self.range.steps.count}")
        return (None if step < 0 else self.range.steps.value(step)), self.max_bits


@dataclass(frozen=True, slots=True)
class SteppedVector:
    """A list of `low` to `high` numbers: its length less `low`, then all steps as one mixed-radix integer."""

    range: Range
    low: int
    high: int
    min_bits: int = field(init=False, repr=False)
    max_bits: int = field(init=False, repr=False)
    sizes: tuple[int, ...] = field(
        init=False, repr=False
    )  # bits of the numbers, by how many more than `low` they are
    count_bits: int = field(init=False, repr=False)

    def __post_init__(self) -> None:
        count = self.range.steps.count
        sizes = tuple(clog2(power(count, n)) for n in range(self.low, self.high + 1))
        object.__setattr__(self, "sizes", sizes)
        object.__setattr__(self, "count_bits", clog2(self.high - self.low + 1))
        object.__setattr__(self, "min_bits", self.count_bits + sizes[0])
        object.__setattr__(self, "max_bits", self.count_bits + sizes[-1])

    @property
    def shown(self) -> tuple[float, float, float] | None:
        """Minimum, maximum and resolution, for tables."""
        return self.range.shown

    def encoder(self, path: str, treatment: Treatment, is_strict: bool) -> BoundEncoder:
        """The encoder of the field at a path."""
        wires = self.range.limits(path, treatment).wires
        fit = fitter(path, self.low, self.high, is_strict)
        count, low, count_bits = self.range.steps.count, self.low, self.count_bits

        def encode(values: Any, deviations: Deviations) -> tuple[int, int]:
            steps = fit(wires(values, deviations), deviations)
            more = len(steps) - low
            return more | join(steps, count) << count_bits, count_bits + self.sizes[more]

        return encode

    def decode(self, bits: int, available: int, now_ns: int | None) -> tuple[list[float | int], int]:
        """The list at the low end of `bits`."""
        more = bits & (1 << self.count_bits) - 1
        if more > self.high - self.low:
            raise DecodeError(f"{self.range.name}: a count of {more + self.low} exceeds {self.high}")
        taken = self.count_bits + self.sizes[more]
        if taken > available:
            raise DecodeError(f"{self.range.name}: the message ends within its {more + self.low} numbers")
        steps = self.range.steps
        joined = bits >> self.count_bits & (1 << self.sizes[more]) - 1
        if joined >= power(steps.count, more + self.low):
            raise DecodeError(f"{self.range.name}: a step is beyond its {steps.count}")
        value = steps.value
        return [value(step) for step in split(joined, steps.count, more + self.low)], taken


def fitter(path: str, low: int, high: int, is_strict: bool) -> Any:
    """What makes a list of steps as long as it may be: an error if strict, else cut, or filled with 0."""
    limits = CountLimits(path, low, high, is_strict)

    def fit(steps: Sequence[int], deviations: Deviations) -> Sequence[int]:
        if low <= len(steps) <= high:
            return steps
        fitted = list(limits.fit(steps, deviations))
        return fitted + [0] * (low - len(fitted))

    return fit

"""Numbers on an exact lattice: minimum, minimum + resolution, ... up to and including the maximum.

Bounds and resolution are rationals, and each value is rounded to its nearest step as the rational that its
bits are: no width and no halfway case depends on the rounding of floating-point formulas.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from fractions import Fraction

MAX_COUNT = 2**64  # values of one number: all those of a 64-bit integer
_RATIONAL = re.compile(r"[+-]?\d{1,40}(\.\d{1,40})?(/\d{1,40})?")


@dataclass(frozen=True, slots=True)
class Steps:
    """The lattice of one number; `count` values, the last of which is the maximum wherever it lies.

    is_integer: values come out as int, else as the double next to the rational.
    """

    minimum: Fraction
    maximum: Fraction
    resolution: Fraction
    is_integer: bool
    count: int = field(init=False, repr=False)
    _origin: int = field(init=False, repr=False)  # minimum, resolution and maximum in units of 1 / _scale
    _step: int = field(init=False, repr=False)
    _end: int = field(init=False, repr=False)
    _scale: int = field(init=False, repr=False)
    _low: float = field(
        init=False, repr=False
    )  # minimum and 1 / resolution as doubles, and how far off, in steps,
    _inverse: float = field(init=False, repr=False)  # what they give is at most
    _margin: float = field(init=False, repr=False)

    def __post_init__(self) -> None:
        low, inverse = _double(self.minimum), _double(1 / self.resolution)
        greatest = max(abs(low), abs(_double(self.maximum)))
        # Five roundings, of 2^-53 each of what is no greater than the steps from 0 to the further bound.
        margin = 2.0**-50 * (2 * greatest * inverse + 1)
        scale = math.lcm(self.minimum.denominator, self.resolution.denominator, self.maximum.denominator)
        for name, value in (
            ("count", math.ceil((self.maximum - self.minimum) / self.resolution) + 1),
            ("_scale", scale),
            ("_origin", int(self.minimum * scale)),
            ("_step", int(self.resolution * scale)),
            ("_end", int(self.maximum * scale)),
            ("_low", low),
            ("_inverse", inverse),
            ("_margin", margin if margin < 0.25 else 1.0),
        ):
            object.__setattr__(self, name, value)

    def index(self, value: float) -> int:
        """The step nearest to a finite value within the bounds; halfway between two, the upper one."""
        steps = (value - self._low) * self._inverse + 0.5
        index = int(steps)
        if self._margin < steps - index < 1 - self._margin and index < self.count - 2:
            return index
        numerator, denominator = value.as_integer_ratio()
        step = self._step * denominator
        index = (2 * (numerator * self._scale - self._origin * denominator) + step) // (2 * step)
        if index < self.count - 2:
            return max(index, 0)
        if self.count == 1:
            return 0
        # The last step may be a short one: what is nearer to the maximum is sent as the maximum.
        middle = self._origin + (self.count - 2) * self._step + self._end
        return self.count - (1 if 2 * numerator * self._scale >= middle * denominator else 2)

    def value(self, index: int) -> float | int:
        """The value of a step of 0 to count - 1."""
        exact = min(self._origin + index * self._step, self._end)
        return exact // self._scale if self.is_integer else exact / self._scale


def _double(number: Fraction) -> float:
    """The double nearest to a rational; infinite beyond all."""
    try:
        return float(number)
    except OverflowError:
        return math.inf


def as_written(number: float) -> Fraction:
    """A double as the shortest decimal that denotes it: 0.1 is a tenth, as in the file that says 0.1."""
    return Fraction(repr(number))


def rational(text: str) -> Fraction | None:
    """The number of a text such as "1/3" or "-0.25"; None if it is none."""
    if not _RATIONAL.fullmatch(text):
        return None
    above, _, below = text.partition("/")
    return None if below and not int(below) else Fraction(above) / int(below or 1)

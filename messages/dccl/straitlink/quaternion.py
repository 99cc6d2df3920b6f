"""Orientations: the smallest three components of a unit quaternion, with a stated greatest error.

The component of greatest magnitude is left out and made positive (q and -q are the same orientation); the
others lie within 1/sqrt(2) and are sent in equal steps. An error e of the three makes one of at most 2 e of
the quaternion, since what is left out is at least 1/2, and a rotation by twice that; three components of
half a step each are off by sqrt(3)/2 steps. So the angle is off by at most 2 sqrt(3) steps, to first order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

_MARGIN = 0.999  # of the step, for the second order: under a thousandth for errors up to 0.1 rad
_KEPT = ((1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2))
_MAX_SUM = 1.0  # of the three squares; valid ones stay at 3/4, less than a step beyond
MIN_ERROR_RAD = 1e-7  # 2^27 steps; what a double's arithmetic stays well within
MAX_ERROR_RAD = 0.1


@dataclass(frozen=True, slots=True)
class QuaternionSteps:
    """Orientations (x, y, z, w) to within `error_rad`.

    half_steps: steps from 0 to 1/sqrt(2); side: steps of each component. count: codes of an orientation,
    not all of which an encoder sends.
    """

    error_rad: float
    step: float = field(init=False, repr=False)
    half_steps: int = field(init=False, repr=False)
    side: int = field(init=False, repr=False)
    count: int = field(init=False, repr=False)

    def __post_init__(self) -> None:
        step = _MARGIN * self.error_rad / (2 * math.sqrt(3))
        half_steps = math.ceil(math.sqrt(0.5) / step)
        object.__setattr__(self, "step", math.sqrt(0.5) / half_steps)
        object.__setattr__(self, "half_steps", half_steps)
        object.__setattr__(self, "side", 2 * half_steps + 1)
        object.__setattr__(self, "count", 4 * self.side**3)

    def digits(self, quaternion: Sequence[float]) -> tuple[int, int, int, int]:
        """Which component is left out, and the steps of the others, from 0. The norm need not be 1."""
        largest = max(range(4), key=lambda i: abs(quaternion[i]))
        norm = math.sqrt(math.fsum(c * c for c in quaternion))
        scale = math.copysign(1 / (norm * self.step), quaternion[largest])
        half = self.half_steps
        a, b, c = (
            max(0, min(2 * half, half + math.floor(quaternion[i] * scale + 0.5))) for i in _KEPT[largest]
        )
        return largest, a, b, c

    def quaternion(self, largest: int, *steps: int) -> tuple[float, float, float, float] | None:
        """The unit quaternion of digits within their ranges; None where no encoder sends them."""
        kept = [(digit - self.half_steps) * self.step for digit in steps]
        square = kept[0] * kept[0] + kept[1] * kept[1] + kept[2] * kept[2]
        if square > _MAX_SUM:
            return None
        kept.insert(largest, math.sqrt(1 - square))
        x, y, z, w = kept
        return x, y, z, w

"""Lists of numbers coded by how much they vary: within one message, so that each decodes alone.

A form number precedes the list: 0 mixed radix, as a list without this codec; 1 differences to the element
before; 2 differences to the straight line through the two before. The encoder takes the shortest. In forms
1 and 2 a difference is coded by a bell whose scale follows the differences so far.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from messages.dccl.custom import BoundEncoder
from messages.dccl.errors import DecodeError
from messages.dccl.limits import Deviations, Treatment
from messages.dccl.straitlink.number import SteppedVector, fitter
from messages.entropy import RangeDecoder, RangeEncoder, Spread

FORM_BITS = 2
_PACKED, _LEVEL, _LINE = range(3)
_SCALE_START = 32  # sixteenths of a step; what the first differences are expected to be
_GREATEST_SCALE = 1 << 24


@dataclass(frozen=True, slots=True)
class AdaptiveVector:
    """A list of numbers with shared bounds, in the shortest of its forms."""

    plain: SteppedVector
    min_bits: int = field(init=False, repr=False)
    max_bits: int = field(init=False, repr=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "min_bits", FORM_BITS + self.plain.count_bits)
        object.__setattr__(self, "max_bits", FORM_BITS + self.plain.max_bits)

    @property
    def shown(self) -> tuple[float, float, float] | None:
        """Minimum, maximum and resolution, for tables."""
        return self.plain.shown

    def encoder(self, path: str, treatment: Treatment, is_strict: bool) -> BoundEncoder:
        """The encoder of the field at a path."""
        plain = self.plain
        wires = plain.range.limits(path, treatment).wires
        fit = fitter(path, plain.low, plain.high, is_strict)
        pack = plain.encoder(path, treatment, is_strict)
        last, prefix_bits = plain.range.steps.count - 1, FORM_BITS + plain.count_bits

        def encode(values: Any, deviations: Deviations) -> tuple[int, int]:
            steps = fit(wires(values, deviations), deviations)
            more = len(steps) - plain.low
            code, bits, form = 0, plain.sizes[more], _PACKED
            for other in (_LEVEL, _LINE):
                shorter, length = _code(steps, last, other)
                if length < bits:
                    code, bits, form = shorter, length, other
            if form == _PACKED:
                packed, taken = pack(values, Deviations([]))
                return form | packed << FORM_BITS, FORM_BITS + taken
            return form | more << FORM_BITS | _reversed(code, bits) << prefix_bits, prefix_bits + bits

        return encode

    def decode(self, bits: int, available: int, now_ns: int | None) -> tuple[list[float | int], int]:
        """The list at the low end of `bits`."""
        form, plain = bits & (1 << FORM_BITS) - 1, self.plain
        if form == _PACKED:
            values, taken = plain.decode(bits >> FORM_BITS, available - FORM_BITS, now_ns)
            return values, FORM_BITS + taken
        more = bits >> FORM_BITS & (1 << plain.count_bits) - 1
        prefix_bits = FORM_BITS + plain.count_bits
        if form > _LINE or more > plain.high - plain.low:
            raise DecodeError(f"{plain.range.name}: form {form} with {more + plain.low} numbers is none")
        # No encoder takes more for this form than for the packed one.
        length = min(max(available - prefix_bits, 0), plain.sizes[more])
        code = _reversed(bits >> prefix_bits & (1 << length) - 1, length)
        steps, taken = _decode(code, length, more + plain.low, plain.range.steps.count - 1, form)
        if taken > length:
            raise DecodeError(f"{plain.range.name}: the message ends within its {more + plain.low} numbers")
        value = plain.range.steps.value
        return [value(step) for step in steps], prefix_bits + taken


class _Course:
    """What the next step is expected to be, and how far off; learns from each."""

    def __init__(self, form: int) -> None:
        self._form = form
        self._before = self._last = 0
        self._seen = 0
        self._scale = _SCALE_START

    def expected(self, last: int) -> tuple[int, int]:
        """The expected step and the scale of the difference in sixteenths of a step; last: greatest step."""
        if self._form == _LINE and self._seen > 1:
            return max(0, min(last, 2 * self._last - self._before)), self._scale
        return self._last, self._scale

    def learn(self, step: int, residual: int) -> None:
        """Take the element in."""
        if self._seen:
            self._scale = max(1, min(_GREATEST_SCALE, (5 * self._scale + 48 * abs(residual)) // 8))
        self._before, self._last = self._last, step
        self._seen += 1


def _code(steps: Sequence[int], last: int, form: int) -> tuple[int, int]:
    coder, course = RangeEncoder(), _Course(form)
    for at, step in enumerate(steps):
        expected, scale = course.expected(last)
        if at == 0 or not Spread(scale, -expected, last - expected).encode(coder, step - expected):
            coder.encode_uniform(step, last + 1)
        course.learn(step, step - expected)
    return coder.finish()


def _decode(code: int, length: int, count: int, last: int, form: int) -> tuple[list[int], int]:
    coder, course = RangeDecoder(code, length), _Course(form)
    steps: list[int] = []
    for at in range(count):
        expected, scale = course.expected(last)
        residual = None if at == 0 else Spread(scale, -expected, last - expected).decode(coder)
        step = min(last, coder.decode_uniform(last + 1)) if residual is None else expected + residual
        course.learn(step, step - expected)
        steps.append(step)
    return steps, coder.taken_bits()


def _reversed(bits: int, length: int) -> int:
    """The range coder's first digit is its highest; a message's first bit is its lowest."""
    return int(f"{bits:0{length}b}"[::-1], 2) if length else 0

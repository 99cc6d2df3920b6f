"""A quaternion field: four numbers x, y, z, w, repeated or in a message, as one code. See quaternion."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from google.protobuf import message_factory
from google.protobuf.descriptor import FieldDescriptor

from messages.dccl.custom import BoundEncoder
from messages.dccl.errors import DecodeError, EncodeError
from messages.dccl.limits import Deviations, Treatment
from messages.dccl.numeric import clog2
from messages.dccl.straitlink.quaternion import QuaternionSteps
from messages.dccl.straitlink.radix import join, split

NAMES = ("x", "y", "z", "w")
_NORM_TOLERANCE = 0.01  # what is further from 1 is no orientation but a mistake


@dataclass(frozen=True, slots=True)
class Orientation:
    """A quaternion within a stated angle. is_message: its components are fields x, y, z and w."""

    name: str
    declared: FieldDescriptor = field(repr=False)
    steps: QuaternionSteps
    is_required: bool
    is_message: bool
    min_bits: int = field(init=False, repr=False)
    max_bits: int = field(init=False, repr=False)

    def __post_init__(self) -> None:
        bits = clog2(self.steps.count + self.offset)
        object.__setattr__(self, "min_bits", bits)
        object.__setattr__(self, "max_bits", bits)

    @property
    def offset(self) -> int:
        """1 where 0 stands for "unset"."""
        return 0 if self.is_required else 1

    @property
    def shown(self) -> tuple[float, float, float] | None:
        """The components' bounds, and the greatest error of the angle, rad."""
        return -1.0, 1.0, self.steps.error_rad

    def components(self, value: Any) -> tuple[float, ...] | None:
        """x, y, z, w of the field's value; None where it is unset."""
        if value is None or (not self.is_message and not self.is_required and not value):
            return None
        return (value.x, value.y, value.z, value.w) if self.is_message else tuple(value)

    def value(self, components: tuple[float, ...] | None) -> Any:
        """The field's value for its components."""
        if not self.is_message:
            return list(components or ())
        if components is None:
            return None
        assert self.declared.message_type is not None  # is_message says so
        made = message_factory.GetMessageClass(self.declared.message_type)()
        for name, component in zip(NAMES, components, strict=True):
            setattr(made, name, component)
        return made

    def digits(
        self, path: str, treatment: Treatment, components: tuple[float, ...], deviations: Deviations
    ) -> tuple[int, ...]:
        """Which component is left out, and the steps of the others; EncodeError for what is no rotation."""
        if len(components) != 4:
            raise EncodeError(f"{path} has {len(components)} elements; a quaternion has 4: x, y, z, w")
        norm = math.hypot(*components)
        if not abs(norm - 1) <= _NORM_TOLERANCE:
            if treatment == "raise" or not 1e-6 <= norm <= 1e100:
                raise EncodeError(
                    f"{path} = {list(components)} is no unit quaternion: its norm is {norm:.7g}"
                )
            deviations.add(path, components, "normalised")
        return self.steps.digits(components)

    def encoder(self, path: str, treatment: Treatment, is_strict: bool) -> BoundEncoder:
        """The encoder of the field at a path."""
        side, bits, offset = self.steps.side, self.max_bits, self.offset

        def encode(value: Any, deviations: Deviations) -> tuple[int, int]:
            components = self.components(value)
            if components is None:
                return 0, bits
            largest, *steps = self.digits(path, treatment, components, deviations)
            return largest + 4 * join(steps, side) + offset, bits

        return encode

    def of_digits(self, largest: int, *steps: int) -> Any:
        """The field's value for digits; DecodeError where they are no unit quaternion."""
        components = self.steps.quaternion(largest, *steps)
        if components is None:
            raise DecodeError(f"{self.name}: {steps} on the wire are no quaternion")
        return self.value(components)

    def decode(self, bits: int, available: int, now_ns: int | None) -> tuple[Any, int]:
        """The quaternion at the low end of `bits`."""
        code = (bits & (1 << self.max_bits) - 1) - self.offset
        if code < 0:
            return self.value(None), self.max_bits
        if code >= self.steps.count:
            raise DecodeError(f"{self.name}: {code} on the wire is no quaternion")
        return self.of_digits(code % 4, *split(code // 4, self.steps.side, 3)), self.max_bits

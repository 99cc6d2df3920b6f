"""What happens to a number that is none of its steps: the same decision as for DCCL's own fields."""

from __future__ import annotations

from dataclasses import dataclass

from messages.dccl.errors import EncodeError
from messages.dccl.limits import Deviations, Treatment
from messages.dccl.straitlink.steps import Steps


@dataclass(frozen=True, slots=True)
class StepLimits:
    """One field's steps, and what to do beyond them.

    low, high: the bounds as values of the field's type, which may lie a rounding beyond the exact ones.
    unset: what is sent in the place of a value out of range with "dccl", less `offset`.
    """

    path: str
    steps: Steps
    low: float
    high: float
    treatment: Treatment
    offset: int = 0

    def wire(self, value: float, deviations: Deviations) -> int:
        """What is sent for a value: its step, plus `offset`."""
        if self.low <= value <= self.high:
            return self.steps.index(value) + self.offset
        return self._beyond(value, self.path, deviations)

    def wires(self, values: list[float], deviations: Deviations) -> list[int]:
        """The same for the elements of a repeated field."""
        low, high, index = self.low, self.high, self.steps.index
        return [
            index(value) if low <= value <= high else self._beyond(value, f"{self.path}[{i}]", deviations)
            for i, value in enumerate(values)
        ]

    def _beyond(self, value: float, path: str, deviations: Deviations) -> int:
        is_nan = value != value
        if self.treatment == "raise" or (is_nan and self.treatment == "clamp"):
            bounds = f"{self.low:.10g} to {self.high:.10g}"
            raise EncodeError(f"{path} = {value:.7g} is not a value within its bounds {bounds}")
        if self.treatment == "clamp":
            deviations.add(path, value, "clamped to its nearest bound")
            return (0 if value < self.low else self.steps.count - 1) + self.offset
        is_unset = self.offset == 1 and not is_nan
        deviations.add(path, value, "sent as unset" if is_unset else "sent as the minimum")
        return 0 if is_unset else self.offset

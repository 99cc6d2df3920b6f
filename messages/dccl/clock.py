"""Times of day: the wire carries the time within a window of days, the receiver's clock gives the rest."""

from __future__ import annotations

import math

from messages.dccl.errors import DecodeError
from messages.dccl.fields import TimeWire

_NS_PER_S = 1_000_000_000


class TimeWindow:
    """Decodes one dccl.time field."""

    def __init__(self, path: str, wire: TimeWire) -> None:
        self._path = path
        self._wire = wire
        self._numeric = wire.numeric

    def value(self, bits: int, now_ns: int | None) -> float | int | None:
        """The time nearest to the receiver's clock, in the field's unit; None for unset.

        now_ns: Unix time; DCCL counts it in whole seconds, and its halves of the window are whole as well.
        """
        n = self._numeric
        if now_ns is None:
            raise DecodeError(f"{self._path} is a dccl.time: decoding it needs now_ns, the receiver's clock")
        if bits > n.greatest_wire:
            raise DecodeError(f"{self._path}: {bits} on the wire is beyond {self._wire.window_s} s")
        time_s = n.value(bits)
        if time_s is None:
            return None
        window_s = self._wire.window_s
        now_s = now_ns // _NS_PER_S
        today_s = now_s % window_s
        start_s = now_s - today_s
        if time_s - today_s > window_s // 2:
            start_s -= window_s
        elif today_s - time_s > window_s // 2:
            start_s += window_s
        time = self._wire.conversion * (start_s + time_s)
        if not self._wire.is_integer:
            return time
        rounded = math.floor(time + 0.5)
        if not 0 <= rounded < 2**63:
            raise DecodeError(f"{self._path}: {rounded} is not a time that the field can hold")
        return rounded

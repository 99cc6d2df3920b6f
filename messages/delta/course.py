"""What each lane of a message is expected to be, and how far off: from what both ends know alike.

All in integers, so that the two ends agree to the bit. Lengths are steps of the lane, scales sixteenths of
a step. The weights were fitted to recorded joint motion (a teleoperated humanoid at 5, 10 and 30 Hz with
references 0.2 to 1 s old, and a walking one); a tenth more or less of any of them matters little.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from messages.delta.lanes import Lane, LaneKind
from messages.delta.leaning import Leaning
from messages.delta.sample import HISTORY, References
from messages.entropy import RangeDecoder, RangeEncoder, Spread

_CALM_SCALE = (60, 12, 4, 2, 2, 1, 1, 1)  # of a lane that stood still, by for how long
_ALONE_SCALE = 320  # without any history
_BACK = 3  # messages before the reference over which its speed is taken at most, if the receiver has one
_LEAD = 4  # messages
_SAME_BITS = 4  # a choice stays what it was in 1 - 2^-4 of messages, less often changed the longer it stood
_MAX_SCALE = 1 << 28


class Expectation:
    """The lanes of one message, coded in order: expected value and scale, corrected by those before it.

    Robots move in groups of joints: where the lanes before were further off than their scales, so will be
    the next ones. The correction is by how much, over the last few lanes.
    """

    def __init__(
        self,
        lanes: tuple[Lane, ...],
        known: References,
        leanings: Mapping[int, Leaning] = MappingProxyType({}),
    ) -> None:
        self._lanes = lanes
        self._known = known
        self._before = known.reference.lanes
        self._off = self._meant = 128
        self._leanings = leanings
        self._moved = [0] * len(lanes)

    def encode(self, coder: RangeEncoder, values: list[int]) -> None:
        """Code all lanes of a message."""
        for at, lane in enumerate(self._lanes):
            value = values[at]
            if lane.count == 1:
                continue
            if lane.guard is not None and values[lane.guard] != self._before[lane.guard]:
                coder.encode_uniform(value, lane.count)
            elif lane.kind is LaneKind.CHOICE:
                self._encode_choice(coder, at, value)
            else:
                expected, scale, is_calm = self._expected(at, lane)
                low, high = _bounds(lane, expected)
                residual = value - expected
                if lane.kind is LaneKind.CIRCLE:
                    residual = (residual - low) % lane.count + low
                if not Spread(scale, low, high).encode(coder, residual):
                    coder.encode_uniform(value, lane.count)
                self._learn(at, residual, scale, is_calm)
                self._moved[at] = value - self._before[at]

    def decode(self, coder: RangeDecoder) -> list[int]:
        """Decode all lanes; each is within its count, whatever the bits."""
        values: list[int] = []
        for at, lane in enumerate(self._lanes):
            if lane.count == 1:
                values.append(0)
            elif lane.guard is not None and values[lane.guard] != self._before[lane.guard]:
                values.append(min(lane.count - 1, coder.decode_uniform(lane.count)))
            elif lane.kind is LaneKind.CHOICE:
                values.append(self._decode_choice(coder, at, lane))
            else:
                expected, scale, is_calm = self._expected(at, lane)
                low, high = _bounds(lane, expected)
                residual = Spread(scale, low, high).decode(coder)
                if residual is None:
                    value = min(lane.count - 1, coder.decode_uniform(lane.count))
                    residual = value - expected
                    if lane.kind is LaneKind.CIRCLE:
                        residual = (residual - low) % lane.count + low
                else:
                    value = (expected + residual) % lane.count
                values.append(value)
                self._learn(at, residual, scale, is_calm)
                self._moved[at] = value - self._before[at]
        return values

    def _expected(self, at: int, lane: Lane) -> tuple[int, int, bool]:
        """The expected value, the scale, and whether the lane stood still."""
        if lane.kind is LaneKind.CIRCLE:
            return self._expected_on_circle(at, lane)
        before, history, distance = self._before[at], self._known.history, self._known.distance
        leaning = self._leanings.get(at)
        if leaning is not None:
            move, scale = leaning.foretell(self._moved)
            return max(0, min(lane.count - 1, before + move)), self._corrected(scale), False
        if not history:
            return before, self._corrected(_ALONE_SCALE), False
        least = greatest = last = back = before
        travelled = 0
        reach = 1 + min(_BACK - 1, distance // 4)
        span = gap_back = 0
        for gap, sample in history:
            value = sample.lanes[at]
            travelled += abs(value - last)
            least, greatest, last, span = min(least, value), max(greatest, value), value, gap
            if gap <= reach or gap_back == 0:
                back, gap_back = value, gap
        if least == greatest:
            return before, _CALM_SCALE[self._known.reference.calm[at]], True
        speed = before - back
        near = abs(before - history[0][1].lanes[at])
        extent = distance * HISTORY * (3 * (greatest - least) + 18 * travelled) // (32 * span)
        scale = 18 + extent + 4 * near + 2 * abs(speed)
        # A motion goes on for some messages and then elsewhere: never further than _LEAD at this speed.
        ahead = abs(speed) * distance * _LEAD // ((_LEAD + distance) * gap_back)
        expected = before + (ahead if speed > 0 else -ahead)
        return max(0, min(lane.count - 1, expected)), self._corrected(scale), False

    def _expected_on_circle(self, at: int, lane: Lane) -> tuple[int, int, bool]:
        """A clock: on from the reference at its mean rate; the scale by how uneven the steps were."""
        before, history, distance = self._before[at], self._known.history, self._known.distance
        if not history:
            return before, max(16, min(_MAX_SCALE, 2 * lane.count)), False
        half = lane.count // 2
        gap_all, oldest = history[-1]
        total = (before - oldest.lanes[at] + half) % lane.count - half
        uneven, last_gap, last = 0, 0, before
        for gap, sample in history:
            step = (last - sample.lanes[at] + half) % lane.count - half
            uneven = max(uneven, abs(step * gap_all - total * (gap - last_gap)) // gap_all)
            last_gap, last = gap, sample.lanes[at]
        expected = (before + total * distance // gap_all) % lane.count
        return expected, min(_MAX_SCALE, 16 + 16 * uneven * (1 if gap_all > 1 else distance)), False

    def _corrected(self, scale: int) -> int:
        scale = min(scale, _MAX_SCALE)
        return max(1, min(_MAX_SCALE, scale * self._off // self._meant))

    def _learn(self, at: int, residual: int, scale: int, is_calm: bool) -> None:
        if self._lanes[at].kind is LaneKind.CIRCLE or (is_calm and residual == 0):
            return
        self._off = self._off * 3 // 4 + 16 * min(abs(residual), _MAX_SCALE) + 1
        self._meant = self._meant * 3 // 4 + scale * 17 // 32 + 1

    def _encode_choice(self, coder: RangeEncoder, at: int, value: int) -> None:
        before, total, count = self._before[at], self._choice_total(at), self._lanes[at].count
        if value == before:
            coder.encode(0, total - 1, total)
        else:
            coder.encode(total - 1, 1, total)
            coder.encode_uniform(value - (value > before), count - 1)

    def _decode_choice(self, coder: RangeDecoder, at: int, lane: Lane) -> int:
        before, total = self._before[at], self._choice_total(at)
        if coder.share(total) < total - 1:
            coder.take(0, total - 1)
            return before
        coder.take(total - 1, 1)
        value = coder.decode_uniform(lane.count - 1)
        return value + (value >= before)

    def _choice_total(self, at: int) -> int:
        return 1 << _SAME_BITS + self._known.reference.calm[at]


def _bounds(lane: Lane, expected: int) -> tuple[int, int]:
    """The least and greatest residual."""
    if lane.kind is LaneKind.CIRCLE:
        return -(lane.count // 2), lane.count - 1 - lane.count // 2
    return -expected, lane.count - 1 - expected

"""A message as a list of small integers and back: what differences are taken of.

Each number of a message whose fields all have a fixed place has a lane: what its codec would send, from 0.
The code is generated once for a schema, as the codec's own is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from functools import lru_cache
from typing import Any

from google.protobuf.message import Message as ProtobufMessage

from messages.dccl.clock import TimeWindow
from messages.dccl.codec import Codec
from messages.dccl.encoder import Policy
from messages.dccl.errors import SchemaError
from messages.dccl.fields import (
    BoolWire,
    EnumWire,
    Field,
    HashWire,
    Message,
    MessageWire,
    NumberWire,
    OwnWire,
    StaticWire,
    TimeWire,
)
from messages.dccl.limits import Deviations, NumberLimits, careful_fmod
from messages.dccl.source import Source, assignment, attribute
from messages.dccl.straitlink.adaptive import AdaptiveVector
from messages.dccl.straitlink.moment import Moment
from messages.dccl.straitlink.number import SteppedNumber, SteppedVector, fitter
from messages.dccl.straitlink.orientation import Orientation
from messages.dccl.straitlink.steps import MAX_COUNT

Gather = Callable[[ProtobufMessage, Deviations], list[int]]
Scatter = Callable[[list[int], int | None], ProtobufMessage]
_MAX_LANES = 4096


class LaneKind(Enum):
    """How one value of a lane relates to the next: near it, near it on a circle, or not at all."""

    NUMBER = "number"
    CIRCLE = "circle"
    CHOICE = "choice"


@dataclass(frozen=True, slots=True)
class Lane:
    """One integer of a message: 0 to count - 1.

    guard: the lane of a choice on which the meaning of this one hangs (such as which component of a
    quaternion is left out); where that has changed, a difference to the value before means nothing.
    """

    kind: LaneKind
    count: int
    guard: int | None = None


@dataclass(frozen=True, slots=True)
class Lanes:
    """The lanes of a schema, with the two functions that fill and read them."""

    lanes: tuple[Lane, ...]
    gather: Gather
    scatter: Scatter


@lru_cache(maxsize=64)  # a peer may open many topics of one encoding
def lanes_of(codec: Codec[Any]) -> Lanes:
    """The lanes of a codec's messages; SchemaError names the field that has none.

    Numbers, bools, enums, times, quaternions and static values have, also repeated (with max_repeat lanes
    and one for the length), optional, in a oneof or in an embedded message; text and repeated messages
    have none.
    """
    plan = _Plan(codec)
    for part in (codec.schema.head, codec.schema.body):
        plan.message("root", part, None)
    plan.into.line("return out")
    plan.back.line("return root")
    if len(plan.lanes) > _MAX_LANES:
        raise SchemaError(f"{codec.schema.name} has {len(plan.lanes)} lanes, more than {_MAX_LANES}")
    return Lanes(
        tuple(plan.lanes),
        plan.into.compile("gather", "root, deviations"),
        plan.back.compile("scatter", "lanes, now_ns"),
    )


class _Plan:
    """Writes both functions side by side, field by field."""

    def __init__(self, codec: Codec[Any]) -> None:
        self.lanes: list[Lane] = []
        self.into, self.back = Source(), Source()
        self._name = codec.schema.name
        self._policy: Policy = codec.policy
        self._hash = codec.wire_hash
        self.into.line("out = []")
        self.back.line(f"root = {self.back.constant('new', codec.message_type)}()")

    def message(self, owner: str, message: Message, guard: int | None) -> None:
        chosen: dict[str, tuple[str, str, int]] = {}
        for oneof in message.oneofs:
            name, place = self.into.name("o"), len(self.lanes)
            places = self.into.constant("places", {None: 0, **{m: i for i, m in enumerate(oneof.members, 1)}})
            self.into.line(f"{name} = {owner}.WhichOneof({oneof.name!r})")
            self.into.line(f"out.append({places}[{name}])")
            self._add(LaneKind.CHOICE, len(oneof.members) + 1, guard)
            for i, member in enumerate(oneof.members, 1):
                chosen[member] = f"{name} == {member!r}", f"lanes[{place}] == {i}", place
        for field in message.fields:
            if field.conditions is not None:
                raise self._unsuitable(field, "has dynamic conditions")
            if field.name in chosen:
                is_set, was_set, place = chosen[field.name]
                self._optional(owner, field, is_set, was_set, place)
            elif field.has_presence_bit or self._is_unset_unmarked(field):
                place = len(self.lanes)
                self._add(LaneKind.CHOICE, 2, guard)
                is_set = f"{owner}.HasField({field.name!r})"
                if field.max_repeat is not None:
                    is_set = f"len({attribute(owner, field.name)}) > 0"
                self.into.line(f"out.append({is_set})")
                self._optional(owner, field, is_set, f"lanes[{place}]", place)
            else:
                self._field(owner, field, guard)

    def _is_unset_unmarked(self, field: Field) -> bool:
        """Whether a field may be unset and has no value of its own for that."""
        wire = field.wire
        if isinstance(wire, OwnWire) and isinstance(wire.codec, Orientation):
            return not wire.codec.is_required
        is_optional = field.max_repeat is None and not field.descriptor.is_required
        return is_optional and isinstance(wire, MessageWire)

    def _optional(self, owner: str, field: Field, is_set: str, was_set: str, guard: int) -> None:
        start = len(self.lanes)
        with self.into.block(f"if {is_set}:"), self.back.block(f"if {was_set}:"):
            self._field(owner, field, guard, is_known_set=True)
        with self.into.block("else:"):
            self.into.line(f"out += {(0,) * (len(self.lanes) - start)}")

    def _field(self, owner: str, field: Field, guard: int | None, is_known_set: bool = False) -> None:
        wire = field.wire
        if isinstance(wire, MessageWire) and field.max_repeat is None:
            inner = self.into.name("m")
            self.into.line(f"{inner} = {attribute(owner, field.name)}")
            self.back.line(f"{inner} = {attribute(owner, field.name)}")
            self.back.line(f"{inner}.SetInParent()")
            self.message(inner, wire.message, guard)
        elif isinstance(wire, StaticWire | HashWire):
            value = wire.value if isinstance(wire, StaticWire) else self._hash & (1 << wire.bits) - 1
            self.back.line(assignment(owner, field.name, self.back.constant("static", value)))
        elif isinstance(wire, OwnWire) and isinstance(wire.codec, Orientation):
            self._orientation(owner, field, wire.codec, guard)
        elif field.max_repeat is not None:
            self._repeated(owner, field, guard)
        else:
            self._singular(owner, field, guard, is_known_set)

    def _singular(self, owner: str, field: Field, guard: int | None, is_known_set: bool) -> None:
        wire, value, kind, count = self._number(field)
        held = attribute(owner, field.name)
        is_always_set = field.descriptor.is_required or is_known_set
        test = "" if is_always_set else f" if {owner}.HasField({field.name!r}) else 0"
        self.into.line(f"out.append({wire}({held}, deviations){test})")
        place = self._add(kind, count, guard)
        name = self.back.name("v")
        self.back.line(f"{name} = {value}(lanes[{place}], now_ns)")
        with self.back.block(f"if {name} is not None:"):
            self.back.line(assignment(owner, field.name, name))

    def _repeated(self, owner: str, field: Field, guard: int | None) -> None:
        low, high = field.min_repeat or 0, field.max_repeat or 0
        if field.is_padded or field.has_presence_bit:
            raise self._unsuitable(field, "is a list of codec_version 2, or of optional elements")
        wire, value, kind, count = self._number(field)
        fit = self.into.constant("fit", fitter(field.path, low, high, self._policy.is_strict))
        values = self.into.name("v")
        held = f"{attribute(owner, field.name)}[:]"
        self.into.line(f"{values} = {fit}([{wire}(v, deviations) for v in {held}], deviations)")
        length = str(high)
        if low != high:
            guard = self._add(LaneKind.CHOICE, high - low + 1, guard)
            self.into.line(f"out.append(len({values}) - {low})")
            length = f"(lanes[{guard}] + {low})"
        start = len(self.lanes)
        self.into.line(f"out += {values}")
        if low != high:
            self.into.line(f"out += (0,) * ({high} - len({values}))")
        for _ in range(high):
            self._add(kind, count, guard)
        made = f"{value}(lane, now_ns) for lane in lanes[{start}:{start} + {length}]"
        self.back.line(f"{attribute(owner, field.name)}.extend([{made}])")

    def _orientation(self, owner: str, field: Field, codec: Orientation, guard: int | None) -> None:
        treatment = self._policy.treatment(field.path)
        held = attribute(owner, field.name)

        def digits(value: Any, deviations: Deviations) -> tuple[int, ...]:
            return codec.digits(field.path, treatment, codec.components(value) or (), deviations)

        self.into.line(f"out += {self.into.constant('digits', digits)}({held}, deviations)")
        place = self._add(LaneKind.CHOICE, 4, guard)
        for _ in range(3):
            self._add(LaneKind.NUMBER, codec.steps.side, place)
        value = f"{self.back.constant('quaternion', codec.of_digits)}(*lanes[{place}:{place + 4}])"
        method = "CopyFrom" if codec.is_message else "extend"
        self.back.line(f"{held}.{method}({value})")

    def _number(self, field: Field) -> tuple[str, str, LaneKind, int]:
        """Expressions of the functions value -> lane and lane -> value; the lane's kind and count."""
        wire = field.wire
        treatment = self._policy.treatment(field.path)
        if isinstance(wire, OwnWire) and isinstance(
            wire.codec, SteppedNumber | SteppedVector | AdaptiveVector
        ):
            codec = wire.codec.plain if isinstance(wire.codec, AdaptiveVector) else wire.codec
            offset = codec.offset if isinstance(codec, SteppedNumber) else 0
            steps, limits = codec.range.steps, codec.range.limits(field.path, treatment, offset)
            return self._pair(
                limits.wire, _from_step(steps.value, offset), _kind(steps.count), steps.count + offset
            )
        if isinstance(wire, OwnWire) and isinstance(wire.codec, Moment):
            moment = wire.codec
            return self._pair(
                lambda v, deviations: moment.residue(field.path, v) + moment.offset,
                lambda lane, now_ns: (
                    moment.time(lane - moment.offset, now_ns) if lane >= moment.offset else None
                ),
                LaneKind.CIRCLE,
                moment.count + moment.offset,
            )
        if isinstance(wire, NumberWire):
            number = NumberLimits(field.path, wire.numeric, treatment)
            return self._pair(
                number.wire,
                lambda lane, now_ns: number.value(lane),
                _kind(wire.numeric.greatest_wire),
                wire.numeric.greatest_wire + 1,
            )
        if isinstance(wire, TimeWire):
            window, time = TimeWindow(field.path, wire), NumberLimits(field.path, wire.numeric, treatment)
            return self._pair(
                lambda v, deviations: time.wire(
                    careful_fmod(v / wire.conversion, float(wire.window_s)), deviations
                ),
                window.value,
                LaneKind.CIRCLE,
                wire.numeric.greatest_wire + 1,
            )
        if isinstance(wire, BoolWire):
            shift = 0 if wire.is_required else 1
            return self._pair(
                lambda v, deviations: v + shift,
                lambda lane, now_ns: lane > shift if lane >= shift else None,
                LaneKind.CHOICE,
                2 + shift,
            )
        if isinstance(wire, EnumWire):
            offset = wire.numeric.offset
            sent: dict[int, int] = {}
            for index, number_ in wire.numbers.items():
                sent.setdefault(number_, index + offset)
            numbers = {index + offset: number_ for index, number_ in wire.numbers.items()}
            return self._pair(
                lambda v, deviations: sent[v],
                lambda lane, now_ns: numbers.get(lane),
                LaneKind.CHOICE,
                wire.numeric.greatest_wire + 1,
            )
        raise self._unsuitable(field, "is no number")

    def _pair(
        self, wire: Callable[..., int], value: Callable[..., Any], kind: LaneKind, count: int
    ) -> tuple[str, str, LaneKind, int]:
        return self.into.constant("wire", wire), self.back.constant("value", value), kind, count

    def _add(self, kind: LaneKind, count: int, guard: int | None) -> int:
        if count > MAX_COUNT:
            raise SchemaError(f"{self._name}: a number of {count} steps is too large for differences")
        self.lanes.append(Lane(kind, count, guard))
        return len(self.lanes) - 1

    def _unsuitable(self, field: Field, why: str) -> SchemaError:
        return SchemaError(f"{self._name}: {field.path} {why}, of which no differences can be taken")


def _kind(count: int) -> LaneKind:
    """A number of so many steps is a time or a counter: it goes on at its rate, whatever its bounds."""
    return LaneKind.CIRCLE if count > 1 << 32 else LaneKind.NUMBER


def _from_step(value: Callable[[int], float], offset: int) -> Callable[[int, int | None], float | None]:
    if offset:
        return lambda lane, now_ns: value(lane - 1) if lane else None
    return lambda lane, now_ns: value(lane)

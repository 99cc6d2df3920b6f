"""From a schema to a compiled encoder: straight Python source with every constant written out.

A message becomes one long integer, first field lowest. Fields of fixed width are summed in small pieces
with constant shifts; `s` variables count bits only from the first field of variable size on.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from operator import lshift

from google.protobuf.message import Message as ProtobufMessage

from messages.dccl.bits import BitWriter
from messages.dccl.conditions import FieldConditions
from messages.dccl.fields import (
    BoolWire,
    CustomWire,
    EnumWire,
    Field,
    HashWire,
    Message,
    MessageWire,
    NumberWire,
    OwnWire,
    TextWire,
    TimeWire,
)
from messages.dccl.limits import (
    CountLimits,
    Deviations,
    NumberLimits,
    RequiredLimits,
    TextLimits,
    Treatment,
    careful_floor,
    careful_fmod,
)
from messages.dccl.numeric import type_bounds
from messages.dccl.schema import Schema
from messages.dccl.source import PACKED_AT_ONCE, Source, attribute, ones, pack, shifts

Encoder = Callable[[ProtobufMessage, Deviations], bytes]


@dataclass(frozen=True, slots=True)
class Policy:
    """What to do with values that do not fit. treatments: by the field's path."""

    is_strict: bool
    treatments: dict[str, Treatment]

    def treatment(self, path: str) -> Treatment:
        """The treatment of a number out of bounds."""
        default: Treatment = "raise" if self.is_strict else "dccl"
        return self.treatments.get(path, self.treatments.get("*", default))


def compile_encoder(
    schema: Schema, policy: Policy, schema_hash: int, restart: Callable[[], None]
) -> tuple[Encoder, str]:
    """The encoder of a schema, and its source. restart: called where a message is encoded once more."""
    plan = _EncoderPlan(schema, policy, schema_hash)
    arguments = "root, deviations"
    names = {"from_bytes": int.from_bytes, "lshift": lshift, "pack": pack}
    fast = plan.source.compile("encode", arguments, floor=math.floor, fmod=math.fmod, **names)
    careful = plan.source.compile("encode", arguments, floor=careful_floor, fmod=careful_fmod, **names)

    def encode(message: ProtobufMessage, deviations: Deviations) -> bytes:
        try:
            return fast(message, deviations)  # type: ignore[no-any-return]
        except (ValueError, OverflowError):
            # NaN or an infinity somewhere: floor() refused it. The careful one says where.
            deviations.found.clear()
            restart()
            return careful(message, deviations)  # type: ignore[no-any-return]

    return encode, plan.source.text("encode", arguments)


class _EncoderPlan:
    def __init__(self, schema: Schema, policy: Policy, schema_hash: int) -> None:
        self.source = Source()
        self._policy = policy
        self._hash = schema_hash
        bits = BitWriter(self.source)
        bits.put(str(schema.id_wire), schema.id_bits)
        self._message(bits, "root", schema.head)
        bits.skip(8 * schema.head_bytes - schema.id_bits - schema.head.max_bits)
        self._message(bits, "root", schema.body)
        bits.flush()
        size = f"({bits.size} + 7) >> 3" if bits.at is None else str((bits.at + 7) // 8)
        value = bits.value if bits.is_assigned else "0"
        self.source.line(f"return {value}.to_bytes({size}, 'little')" if bits.is_assigned else "return b''")

    # MESSAGES AND FIELDS

    def _message(self, bits: BitWriter, owner: str, message: Message) -> None:
        chosen = {}
        for oneof in message.oneofs:
            name = self.source.name("o")
            places = {member: i + 1 for i, member in enumerate(oneof.members)}
            table = self.source.constant("places", {None: 0, **places})
            self.source.line(f"{name} = {owner}.WhichOneof({oneof.name!r})")
            bits.put(f"{table}[{name}]", oneof.bits)
            chosen.update(dict.fromkeys(oneof.members, name))
        for f in message.fields:
            if f.conditions is not None:
                self._conditional(bits, owner, f, chosen.get(f.name))
            elif isinstance(f.wire, CustomWire | OwnWire):
                self._custom(bits, owner, f, chosen.get(f.name))
            elif f.max_repeat is not None:
                self._repeated(bits, owner, f)
            else:
                self._singular(bits, owner, f, chosen.get(f.name))

    def _singular(self, bits: BitWriter, owner: str, f: Field, oneof: str | None, numeric: str = "") -> None:
        value = attribute(owner, f.name)
        is_forced = f.is_required and not f.descriptor.is_required and oneof is None
        if f.descriptor.is_required:
            self._element(bits, value, f, numeric)
            return
        test = f"{oneof} == {f.name!r}" if oneof else f"{owner}.HasField({f.name!r})"
        low, high = f.element_size
        if oneof:
            low = 0
        inner = BitWriter(self.source)
        is_fixed = low == high and not numeric
        with self.source.block(f"if {test}:"):
            self._element(inner, value, f, numeric)
            inner.finish(is_fixed)
        with self.source.block("else:"):
            self.source.line(f"{inner.value} = 0")
            if is_forced:
                missing = self.source.constant("missing", RequiredLimits(f.path, self._policy.is_strict))
                self.source.line(f"{missing}.missing(deviations)")
            if not is_fixed:
                self.source.line(f"{inner.size} = {f'{numeric}.bits' if numeric else low}")
        bits.append(inner, low if is_fixed else None)

    def _repeated(self, bits: BitWriter, owner: str, f: Field) -> None:
        values, count = self._fitted(owner, f)
        if isinstance(f.wire, NumberWire | BoolWire | EnumWire) and not f.has_presence_bit:
            self._array(bits, values, count, f)
            return
        self._count_prefix(bits, count, f)
        bits.vary()
        element = self.source.name("e")
        with self.source.block(f"for {element} in {values}:"):
            inner = BitWriter(self.source)
            self._element(inner, element, f)
            inner.finish(False)
            bits.append(inner, None)
        self._fill_up(bits, count, f)

    def _conditional(self, bits: BitWriter, owner: str, f: Field, oneof: str | None) -> None:
        conditions = self.source.constant("conditions", FieldConditions(f))
        outcome = self.source.name("c")
        required = f.when_required
        assert required is not None  # every field with conditions has both forms
        has_bounds = f.conditions is not None and (f.conditions.minimum or f.conditions.maximum) is not None
        numeric = f"{outcome}.numeric" if has_bounds else ""
        if f.max_repeat is None:
            bits.vary()
            self.source.line(f"{outcome} = {conditions}.evaluate(root, {owner}, 0)")
            with self.source.block(f"if not {outcome}.is_omitted:"):
                with self.source.block(f"if {outcome}.is_required:"):
                    self._singular(bits, owner, required, oneof, numeric)
                    bits.vary()
                with self.source.block("else:"):
                    self._singular(bits, owner, f, oneof, numeric)
                    bits.vary()
            return
        values, count = self._fitted(owner, f)
        self._count_prefix(bits, count, f)
        bits.vary()
        index, element = self.source.name("i"), self.source.name("e")
        with self.source.block(f"for {index}, {element} in enumerate({values}, 1):"):
            self.source.line(f"{outcome} = {conditions}.evaluate(root, {owner}, {index})")
            with self.source.block(f"if not {outcome}.is_omitted:"):
                inner = BitWriter(self.source)
                self._element(inner, element, f, numeric)
                inner.finish(False)
                bits.append(inner, None)

    def _custom(self, bits: BitWriter, owner: str, f: Field, oneof: str | None) -> None:
        wire = f.wire
        assert isinstance(wire, CustomWire | OwnWire)  # the caller has looked
        if isinstance(wire, OwnWire):
            bound = wire.codec.encoder(f.path, self._policy.treatment(f.path), self._policy.is_strict)
            encode, deviations = self.source.constant("encode", bound), ", deviations"
        else:
            encode, deviations = f"{self.source.constant('codec', wire.codec)}.encode", ""
        value = attribute(owner, f.name)
        if f.max_repeat is not None:
            value = f"{value}[:]"
        elif not f.descriptor.is_required:
            value = f"{value} if {owner}.HasField({f.name!r}) else None"
        inner = BitWriter(self.source)
        result = f"{encode}({value}{deviations})"
        if oneof:
            result = f"{encode}({attribute(owner, f.name)}{deviations}) if {oneof} == {f.name!r} else (0, 0)"
        self.source.line(f"{inner.value}, {inner.size} = {result}")
        inner.is_assigned, inner.at = True, None
        low, high = (0, 1) if oneof else wire.size
        bits.append(inner, low if low == high else None)

    # ELEMENTS

    def _element(self, bits: BitWriter, value: str, f: Field, numeric: str = "") -> None:
        """One value that is set, with its presence bit. numeric: the expression of dynamic bounds."""
        if f.has_presence_bit:
            bits.put("1", 1)
        wire = f.wire
        if isinstance(wire, MessageWire):
            name = self.source.name("m")
            if not wire.message.is_empty:
                self.source.line(f"{name} = {value}")
            self._message(bits, name, wire.message)
        elif numeric:
            limits = self._limits(f)
            bits.vary()
            self.source.line(
                f"{bits.value} += {limits}.wire_within({numeric}, {value}, deviations) << {bits.size}"
            )
            self.source.line(f"{bits.size} += {numeric}.bits")
        elif isinstance(wire, NumberWire | TimeWire):
            self._number(bits, value, f, wire)
        elif isinstance(wire, BoolWire):
            bits.put(value, wire.size[0], bias=0 if wire.is_required else -1)
        elif isinstance(wire, EnumWire):
            bits.put(f"{self._enum_table(wire)}[{value}]", wire.numeric.bits)
        elif isinstance(wire, TextWire):
            self._text(bits, value, f, wire)
        elif isinstance(wire, HashWire):
            bits.put(str(self._hash & ((1 << wire.bits) - 1)), wire.bits)

    def _number(self, bits: BitWriter, value: str, f: Field, wire: NumberWire | TimeWire) -> None:
        n = wire.numeric
        if isinstance(wire, TimeWire):
            time = self.source.name("t")
            self.source.line(f"{time} = fmod({value} / {wire.conversion!r}, {float(wire.window_s)!r})")
            value = time
        if not n.is_affine:
            bits.put(f"{self._limits(f)}.wire({value}, deviations)", n.bits)
            return
        index = self.source.name("k")
        self.source.line(f"{index} = {_index_of(value, wire)}")
        if n.is_float or (n.lowest, n.highest) != type_bounds(n.number_type):
            with self.source.block(f"if not {n.lowest} <= {index} <= {n.highest}:"):
                self.source.line(f"{index} = {self._limits(f)}.index({value}, deviations)")
        bits.put(index, n.bits, bias=n.origin - n.offset)

    def _text(self, bits: BitWriter, value: str, f: Field, wire: TextWire) -> None:
        content = self.source.name("b")
        limits = self.source.constant("limits", TextLimits(f.path, wire.max_length, self._policy.is_strict))
        self.source.line(f"{content} = {value}")
        if wire.is_string:
            # A string that protobuf parsed from invalid UTF-8 reads as bytes.
            with self.source.block(f"if {content}.__class__ is str:"):
                self.source.line(f"{content} = {content}.encode()")
        with self.source.block(f"if len({content}) > {wire.max_length}:"):
            self.source.line(f"{content} = {limits}.cut({content}, deviations)")
        if wire.is_fixed:
            bits.put(f"from_bytes({content}, 'little')", 8 * wire.max_length)
            return
        bits.vary()
        packed = f"len({content}) | from_bytes({content}, 'little') << {wire.prefix_bits}"
        self.source.line(f"{bits.value} += ({packed}) << {bits.size}")
        self.source.line(f"{bits.size} += {wire.prefix_bits} + 8 * len({content})")

    def _limits(self, f: Field) -> str:
        assert isinstance(f.wire, NumberWire | TimeWire)  # the only ones with bounds
        treatment = self._policy.treatment(f.path)
        return self.source.constant("limits", NumberLimits(f.path, f.wire.numeric, treatment))

    def _enum_table(self, wire: EnumWire) -> str:
        table: dict[int, int] = {}
        for index, number in wire.numbers.items():
            table.setdefault(number, index + wire.numeric.offset)
        return self.source.constant("enum", table)

    # REPEATED FIELDS

    def _fitted(self, owner: str, f: Field) -> tuple[str, str]:
        """Names of the list of elements and of its length, cut to max_repeat."""
        values, count = self.source.name("v"), self.source.name("n")
        low, high = f.min_repeat or 0, f.max_repeat or 0
        limits = self.source.constant("limits", CountLimits(f.path, low, high, self._policy.is_strict))
        self.source.line(f"{values} = {attribute(owner, f.name)}[:]")
        self.source.line(f"{count} = len({values})")
        test = f"{count} > {high}" if low == 0 else f"not {low} <= {count} <= {high}"
        with self.source.block(f"if {test}:"):
            self.source.line(f"{values} = {limits}.fit({values}, deviations)")
            self.source.line(f"{count} = len({values})")
        return values, count

    def _count_prefix(self, bits: BitWriter, count: str, f: Field) -> None:
        if f.count_bits:
            low = f.min_repeat or 0
            bits.put(f"max({count}, {low})" if low else count, f.count_bits, bias=low)

    def _fill_up(self, bits: BitWriter, count: str, f: Field) -> None:
        least = (f.max_repeat if f.is_padded else f.min_repeat) or 0
        unset_bits = f.element_size[0]
        if least and unset_bits:
            with self.source.block(f"if {count} < {least}:"):
                self.source.line(f"{bits.size} += ({least} - {count}) * {unset_bits}")

    def _array(self, bits: BitWriter, values: str, count: str, f: Field) -> None:
        packed = self._packed(values, count, f)
        width = f.element_size[0]
        high, low = f.max_repeat or 0, f.min_repeat or 0
        self._count_prefix(bits, count, f)
        if f.is_padded or low == high:
            bits.put(packed, high * width)
            return
        bits.vary()
        self.source.line(f"{bits.value} += {packed} << {bits.size}")
        length = f"max({count}, {low})" if low else count
        self.source.line(f"{bits.size} += {length} * {width}")

    def _packed(self, values: str, count: str, f: Field) -> str:
        """An expression for the elements as one integer."""
        wire, bias = f.wire, 0
        if isinstance(wire, NumberWire):
            n = wire.numeric
            limits = self._limits(f)
            if n.is_affine:
                bias = n.origin - n.offset
                indices = self.source.name("k")
                self.source.line(f"{indices} = [{_index_of('v', wire)} for v in {values}]")
                outside = f"min({indices}) < {n.lowest} or max({indices}) > {n.highest}"
                with self.source.block(f"if {indices} and ({outside}):"):
                    self.source.line(f"{indices} = {limits}.indices({values}, deviations)")
            else:
                indices = f"{limits}.wires({values}, deviations)"
        elif isinstance(wire, EnumWire):
            table = self._enum_table(wire)
            indices = f"[{table}[v] for v in {values}]"
        else:
            bias = 0 if f.is_required else -1
            indices = values
        width, high = f.element_size[0], f.max_repeat or 0
        if high > PACKED_AT_ONCE:
            return f"pack({indices}, {width}, {bias})"
        packed = f"sum(map(lshift, {indices}, {self.source.constant('shifts', shifts(width, high))}))"
        if bias == 0:
            return packed
        biases = tuple(bias * ones(width, n) for n in range(high + 1))
        return f"({packed} - {self.source.constant('bias', biases)}[{count}])"


def _index_of(value: str, wire: NumberWire | TimeWire) -> str:
    n = wire.numeric
    if not n.is_float:
        return value
    if n.resolution == 1:
        return f"floor({value} + 0.5)"
    scaled = f"{value} / {n.resolution!r}" if n.resolution >= 1 else f"{value} * {n.inverse!r}"
    return f"floor({scaled} + 0.5)"

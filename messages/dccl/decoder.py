"""From a schema to a compiled decoder, the encoder's mirror.

The bytes become one long integer, read through pieces of it at constant shifts for as long as the place
is known, at `s` from the first field of variable size on. What lies beyond the bytes reads as zeros, and
one comparison at the end tells whether anything was read there.
"""

from __future__ import annotations

from collections.abc import Callable

from google.protobuf.message import Message as ProtobufMessage

from messages.dccl.bits import BitReader
from messages.dccl.clock import TimeWindow
from messages.dccl.conditions import FieldConditions
from messages.dccl.errors import DecodeError
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
    StaticWire,
    TextWire,
    TimeWire,
)
from messages.dccl.limits import CountLimits, NumberLimits, TextLimits
from messages.dccl.schema import Schema
from messages.dccl.source import PACKED_AT_ONCE, Source, assignment, attribute, shifts, unpack

Decoder = Callable[[bytes, int | None], tuple[ProtobufMessage, int]]


def compile_decoder(
    schema: Schema, message_type: Callable[[], ProtobufMessage], schema_hash: int
) -> tuple[Decoder, str]:
    """The decoder of a schema, and its source.

    It takes the bytes and the receiver's Unix time in ns (for time fields), and returns the message
    and how many bytes it took; or raises DecodeError.
    """
    plan = _DecoderPlan(schema, schema_hash)
    arguments = "data, now_ns"
    names = {"from_bytes": int.from_bytes, "unpack": unpack, "new": message_type, "DecodeError": DecodeError}
    return plan.source.compile("decode", arguments, **names), plan.source.text("decode", arguments)


class _DecoderPlan:
    def __init__(self, schema: Schema, schema_hash: int) -> None:
        self.source = Source()
        self._name = schema.name
        self._hash = schema_hash
        self._bits = BitReader(self.source)
        line = self.source.line
        line("size = len(data)")
        with self.source.block(f"if size < {schema.min_bytes}:"):
            least = f"the least size of {schema.name}, {schema.min_bytes}"
            line(f"raise DecodeError(f'{{size}} bytes are fewer than {least}')")
        line(f"x = from_bytes(data[:{schema.max_bytes}], 'little')")
        if schema.id_bits:
            with self.source.block(f"if {self._bits.read(schema.id_bits)} != {schema.id_wire}:"):
                expected = f"the id of {schema.name}, {schema.options.message_id}"
                line(f"raise DecodeError('the first bytes are not {expected}')")
        line("root = new()")
        self._message("root", schema.head)
        self._bits.jump(8 * schema.head_bytes)
        self._message("root", schema.body)
        line(f"end = ({self._bits.place()} + 7) >> 3")
        if self._bits.is_varying:
            with self.source.block("if end > size:"):
                line(f"raise DecodeError(f'{{size}} bytes end within {schema.name}; it takes {{end}}')")
        line("return root, end")

    # MESSAGES AND FIELDS

    def _message(self, owner: str, message: Message) -> None:
        chosen: dict[str, str] = {}
        for oneof in message.oneofs:
            name = self.source.name("o")
            self.source.line(f"{name} = {self._bits.read(oneof.bits)}")
            with self.source.block(f"if {name} > {len(oneof.members)}:"):
                what = f"{self._name}: oneof {oneof.name} has no member"
                self.source.line(f"raise DecodeError(f'{what} {{{name}}}')")
            chosen.update({member: f"{name} == {i}" for i, member in enumerate(oneof.members, 1)})
        for f in message.fields:
            if f.conditions is not None:
                self._conditional(owner, f, chosen.get(f.name))
            elif isinstance(f.wire, CustomWire | OwnWire) and f.name in chosen:
                with self._bits.branch(f"if {chosen[f.name]}:"):
                    self._custom(owner, f)
            elif isinstance(f.wire, CustomWire | OwnWire):
                self._custom(owner, f)
            elif f.max_repeat is not None:
                self._repeated(owner, f)
            elif f.name in chosen:
                with self._bits.branch(f"if {chosen[f.name]}:"):
                    self._singular(owner, f)
            else:
                self._singular(owner, f)

    def _singular(self, owner: str, f: Field, numeric: str = "") -> None:
        if not f.has_presence_bit:
            self._element(owner, f, numeric)
            return
        with self._bits.branch(f"if {self._bits.read(1)}:"):
            self._element(owner, f, numeric)

    def _conditional(self, owner: str, f: Field, chosen: str | None) -> None:
        conditions = self.source.constant("conditions", FieldConditions(f))
        outcome = self.source.name("c")
        required = f.when_required
        assert required is not None and f.conditions is not None  # fields with conditions have both forms
        has_bounds = f.conditions.minimum is not None or f.conditions.maximum is not None
        numeric = f"{outcome}.numeric" if has_bounds else ""
        if f.max_repeat is not None:
            self._conditional_elements(owner, f, conditions, outcome, numeric)
            return
        with self._bits.branch(f"if {chosen}:" if chosen else "if True:"):
            self.source.line(f"{outcome} = {conditions}.evaluate(root, {owner}, 0)")
            with self._bits.branch(f"if not {outcome}.is_omitted:"):
                with self._bits.branch(f"if {outcome}.is_required:"):
                    self._singular(owner, required, numeric)
                with self._bits.branch(f"if not {outcome}.is_required:"):
                    self._singular(owner, f, numeric)

    def _conditional_elements(
        self, owner: str, f: Field, conditions: str, outcome: str, numeric: str
    ) -> None:
        count = self._count(f)
        index = self.source.name("i")
        self._bits.vary()
        with self._bits.branch(f"for {index} in range(1, {count} + 1):"):
            self.source.line(f"{outcome} = {conditions}.evaluate(root, {owner}, {index})")
            with self._bits.branch(f"if not {outcome}.is_omitted:"):
                self._added(owner, f, numeric)

    def _custom(self, owner: str, f: Field) -> None:
        wire = f.wire
        assert isinstance(wire, CustomWire | OwnWire)  # the caller has looked
        codec = self.source.constant("codec", wire.codec)
        value, taken = self.source.name("v"), self.source.name("n")
        place = self._bits.place()
        now = ", now_ns" if isinstance(wire, OwnWire) else ""
        self.source.line(f"{value}, {taken} = {codec}.decode(x >> {place}, 8 * size - ({place}){now})")
        if f.max_repeat is not None:
            self.source.line(f"{attribute(owner, f.name)}.extend({value})")
        else:
            with self.source.block(f"if {value} is not None:"):
                if f.descriptor.message_type is not None:
                    self.source.line(f"{attribute(owner, f.name)}.CopyFrom({value})")
                else:
                    self.source.line(assignment(owner, f.name, value))
        low, high = wire.size
        if low == high:
            self._bits.skip(low)
            return
        self._bits.vary()
        self.source.line(f"s += {taken}")

    # ELEMENTS

    def _element(self, owner: str, f: Field, numeric: str) -> None:
        """A singular field's value, present unless its own bits say that it is unset."""
        wire = f.wire
        if isinstance(wire, MessageWire):
            name = self.source.name("m")
            self.source.line(f"{name} = {attribute(owner, f.name)}")
            if not f.codec_name.endswith("2"):
                # Version 2 has no presence bits: an embedded message is there if any of its fields is.
                self.source.line(f"{name}.SetInParent()")
            self._message(name, wire.message)
            return
        value, test = self._value(f, numeric)
        statement = assignment(owner, f.name, value)
        if test:
            with self.source.block(f"if {test}:"):
                self.source.line(statement)
        else:
            self.source.line(statement)

    def _value(self, f: Field, numeric: str = "") -> tuple[str, str]:
        """Expressions for a value and for whether it is set ("" for always); moves on."""
        wire = f.wire
        if numeric:
            value = self.source.name("v")
            limits = self._limits(f)
            self._bits.vary()
            mask = f"((1 << {numeric}.bits) - 1)"
            self.source.line(f"{value} = {limits}.value_within({numeric}, x >> s & {mask})")
            self.source.line(f"s += {numeric}.bits")
            return value, f"{value} is not None"
        if isinstance(wire, NumberWire):
            return self._number(f, wire)
        if isinstance(wire, TimeWire):
            window = self.source.constant("time", TimeWindow(f.path, wire))
            value = self.source.name("v")
            self.source.line(f"{value} = {window}.value({self._bits.read(wire.numeric.bits)}, now_ns)")
            return value, "" if wire.numeric.is_required else f"{value} is not None"
        if isinstance(wire, BoolWire):
            if wire.is_required:
                return f"{self._bits.read(1)} == 1", ""
            bits = self.source.name("u")
            self.source.line(f"{bits} = {self._bits.read(2)}")
            with self.source.block(f"if {bits} == 3:"):
                self.source.line(f"raise DecodeError({f'{f.path}: 3 on the wire is no bool'!r})")
            return f"{bits} == 2", bits
        if isinstance(wire, EnumWire):
            table = self._enum_table(wire)
            value = self.source.name("v")
            self.source.line(f"{value} = {table}.get({self._bits.read(wire.numeric.bits)})")
            return value, f"{value} is not None"
        if isinstance(wire, TextWire):
            return self._text(f, wire)
        if isinstance(wire, HashWire):
            value = self.source.name("v")
            self.source.line(f"{value} = {self._bits.read(wire.bits)}")
            with self.source.block(f"if {value} != {self._hash & ((1 << wire.bits) - 1)}:"):
                self.source.line(
                    f"raise DecodeError({f'{f.path}: the sender has another schema of {self._name}'!r})"
                )
            return value, ""
        assert isinstance(wire, StaticWire)  # messages and custom codecs are treated elsewhere
        return self.source.constant("static", wire.value), ""

    def _number(self, f: Field, wire: NumberWire) -> tuple[str, str]:
        n = wire.numeric
        limits = self._limits(f)
        if not n.is_affine:
            value = self.source.name("v")
            self.source.line(f"{value} = {limits}.value({self._bits.read(n.bits)})")
            return value, f"{value} is not None"
        greatest = n.greatest_wire
        is_checked = greatest < (1 << n.bits) - 1
        bits = self._bits.read(n.bits)
        if is_checked or not n.is_required:
            name = self.source.name("u")
            self.source.line(f"{name} = {bits}")
            bits = name
        if is_checked:
            with self.source.block(f"if {bits} > {greatest}:"):
                self.source.line(f"raise {limits}.beyond({bits})")
        return _affine(bits, n.origin - n.offset, wire), "" if n.is_required else bits

    def _text(self, f: Field, wire: TextWire) -> tuple[str, str]:
        content = self.source.name("b")
        limits = self.source.constant("limits", TextLimits(f.path, wire.max_length, True))
        test = ""
        if wire.is_fixed:
            bits = self._bits.read(8 * wire.max_length, is_alone=True)
            self.source.line(f"{content} = {bits}.to_bytes({wire.max_length}, 'little')")
        else:
            length = self.source.name("n")
            self.source.line(f"{length} = {self._bits.read(wire.prefix_bits)}")
            if wire.max_length < (1 << wire.prefix_bits) - 1:
                with self.source.block(f"if {length} > {wire.max_length}:"):
                    self.source.line(f"raise {limits}.too_long({length})")
            self._bits.vary()
            mask = f"((1 << 8 * {length}) - 1)"
            self.source.line(f"{content} = (x >> s & {mask}).to_bytes({length}, 'little')")
            self.source.line(f"s += 8 * {length}")
            test = content if wire.empty_is_unset else ""
        return (f"{limits}.text({content})" if wire.is_string else content), test

    def _limits(self, f: Field) -> str:
        assert isinstance(f.wire, NumberWire | TimeWire)  # the only ones with bounds
        return self.source.constant("limits", NumberLimits(f.path, f.wire.numeric, "raise"))

    def _enum_table(self, wire: EnumWire) -> str:
        offset = wire.numeric.offset
        return self.source.constant("enum", {i + offset: number for i, number in wire.numbers.items()})

    # REPEATED FIELDS

    def _count(self, f: Field) -> str:
        low, high = f.min_repeat or 0, f.max_repeat or 0
        if f.is_padded or low == high:
            return str(high)
        count = self.source.name("n")
        self.source.line(f"{count} = {self._bits.read(f.count_bits)}{f' + {low}' if low else ''}")
        if high - low < (1 << f.count_bits) - 1:
            limits = self.source.constant("limits", CountLimits(f.path, low, high, True))
            with self.source.block(f"if {count} > {high}:"):
                self.source.line(f"raise {limits}.too_many({count})")
        return count

    def _repeated(self, owner: str, f: Field) -> None:
        count = self._count(f)
        if isinstance(f.wire, NumberWire | BoolWire | EnumWire) and not f.has_presence_bit:
            self._array(owner, count, f)
            return
        self._bits.vary()
        with self._bits.branch(f"for _ in range({count}):"):
            if f.has_presence_bit:
                with self._bits.branch(f"if {self._bits.read(1)}:"):
                    self._added(owner, f)
            else:
                self._added(owner, f)

    def _added(self, owner: str, f: Field, numeric: str = "") -> None:
        """One more element of a repeated field, if its bits do not say that it is unset."""
        elements = attribute(owner, f.name)
        wire = f.wire
        if isinstance(wire, MessageWire):
            name = self.source.name("m")
            self.source.line(f"{name} = {elements}.add()")
            self._message(name, wire.message)
            if f.is_padded:
                with self.source.block(f"if not {name}.ListFields():"):
                    self.source.line(f"del {elements}[-1]")
            return
        value, test = self._value(f, numeric)
        with self.source.block(f"if {test or True}:"):
            self.source.line(f"{elements}.append({value})")

    def _array(self, owner: str, count: str, f: Field) -> None:
        wire = f.wire
        bits, loop = self._unpacked(count, f, f.element_size[0])
        extend = f"{attribute(owner, f.name)}.extend"
        if isinstance(wire, EnumWire):
            table = self._enum_table(wire)
            self.source.line(f"{extend}([{table}[u] for u in [{bits} {loop}] if u in {table}])")
        elif isinstance(wire, BoolWire) and wire.is_required:
            self.source.line(f"{extend}([{bits} == 1 {loop}])")
        elif isinstance(wire, BoolWire):
            self.source.line(f"{extend}([u == 2 for u in [{bits} {loop}] if u])")
        else:
            self._number_array(extend, bits, loop, f)

    def _number_array(self, extend: str, bits: str, loop: str, f: Field) -> None:
        wire, limits = f.wire, self._limits(f)
        assert isinstance(wire, NumberWire)  # the caller has looked
        n = wire.numeric
        if not n.is_affine:
            values = f"[{limits}.value({bits}) {loop}]"
            self.source.line(f"{extend}([v for v in {values} if v is not None])")
            return
        values, shift = self.source.name("v"), n.origin - n.offset
        if n.is_required:
            self.source.line(f"{values} = [{_affine(bits, shift, wire)} {loop}]")
        else:
            self.source.line(f"{values} = [{_affine('u', shift, wire)} for u in [{bits} {loop}] if u]")
        if n.greatest_wire < (1 << n.bits) - 1:
            # Values rise with their integers, so the greatest tells.
            greatest = _affine(str(n.greatest_wire), shift, wire)
            with self.source.block(f"if {values} and max({values}) > {greatest}:"):
                self.source.line(f"raise {limits}.beyond_value(max({values}))")
        self.source.line(f"{extend}({values})")

    def _unpacked(self, count: str, f: Field, width: int) -> tuple[str, str]:
        """An array's wire integer as an expression, and the loop over the elements; moves on."""
        high = f.max_repeat or 0
        is_short = high <= PACKED_AT_ONCE
        packed = self.source.name("p")
        if count.isdigit():
            self.source.line(f"{packed} = {self._bits.read(width * high, is_alone=True)}")
            places = self.source.constant("shifts", shifts(width, high)) if is_short else ""
        else:
            self._bits.vary()
            mask = f"((1 << {width} * {count}) - 1)"
            if is_short:
                masks = tuple((1 << width * n) - 1 for n in range(high + 1))
                mask = f"{self.source.constant('masks', masks)}[{count}]"
                table = tuple(shifts(width, n) for n in range(high + 1))
                places = f"{self.source.constant('shifts', table)}[{count}]"
            self.source.line(f"{packed} = x >> s & {mask}")
            self.source.line(f"s += {width} * {count}")
        if not is_short:
            return "u", f"for u in unpack({packed}, {width}, {count})"
        return f"({packed} >> i & {(1 << width) - 1})", f"for i in {places}"


def _affine(bits: str, shift: int, wire: NumberWire) -> str:
    n = wire.numeric
    index = f"({bits} + {shift})" if shift > 0 else f"({bits} - {-shift})" if shift < 0 else bits
    if not n.is_float or n.resolution == 1:
        return index
    return f"{index} * {n.resolution!r}" if n.resolution >= 1 else f"{index} / {n.inverse!r}"

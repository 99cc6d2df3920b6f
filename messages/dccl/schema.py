"""From a protobuf descriptor to a checked schema: what each field is on the wire, and in which part.

All that DCCL checks when it loads a message is checked here, once; SchemaError names message, field and
value.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace

from google.protobuf.descriptor import Descriptor, FieldDescriptor

from messages.dccl.arithmetic import ModelInUse
from messages.dccl.custom import FieldCodecs
from messages.dccl.errors import SchemaError
from messages.dccl.fields import (
    CustomWire,
    EnumWire,
    Field,
    Message,
    MessageWire,
    NumberWire,
    OneOf,
    OwnWire,
    Part,
    TimeWire,
    Wire,
)
from messages.dccl.numeric import clog2
from messages.dccl.options import FieldOptions, MessageOptions, field_options, root_options
from messages.dccl.wire_choice import CodecName, bind_wire, codec_name

# Methods that the compiled code calls; a field of the same name hides them.
_METHODS = (
    "CopyFrom",
    "FindInitializationErrors",
    "HasField",
    "IsInitialized",
    "ListFields",
    "SetInParent",
    "WhichOneof",
)


@dataclass(frozen=True, slots=True)
class Schema:
    """A message type as it lies on the wire: id and head fields, then body fields, each padded to a byte."""

    descriptor: Descriptor
    options: MessageOptions
    head: Message
    body: Message

    @property
    def name(self) -> str:
        """The message's full name."""
        return str(self.descriptor.full_name)

    @property
    def id_bits(self) -> int:
        """Bits of the message's id: 0, 8 or 16."""
        if self.options.omit_id or self.options.message_id is None:
            return 0
        return 8 if self.options.message_id <= 127 else 16

    @property
    def id_wire(self) -> int:
        """The id as an integer of id_bits."""
        if self.id_bits == 0 or self.options.message_id is None:
            return 0
        return self.options.message_id << 1 | (1 if self.id_bits == 16 else 0)

    @property
    def head_bytes(self) -> int:
        """Bytes of id and head; the same for all messages of the type."""
        return _bytes(self.id_bits + self.head.max_bits)

    @property
    def min_bytes(self) -> int:
        """The least a message takes."""
        return self.head_bytes + _bytes(self.body.min_bits)

    @property
    def max_bytes(self) -> int:
        """The most a message takes."""
        return self.head_bytes + _bytes(self.body.max_bits)

    @property
    def reported_bytes(self) -> tuple[int, int]:
        """Least and greatest size as DCCL reports them, which takes any id for one and two bytes long."""
        low, high = (0, 0) if self.id_bits == 0 else (8, 16)
        # With dynamic conditions DCCL counts nothing of the body, not even what is always there.
        is_dynamic = any(field.conditions is not None for field in self.body.fields)
        least = _bytes(low + self.head.min_bits) + (0 if is_dynamic else _bytes(self.body.min_bits))
        return least, _bytes(high + self.head.max_bits) + _bytes(self.body.max_bits)

    def hash(self) -> int:
        """64 bits that differ where the bytes would mean something else; the same on every platform."""
        text = "\n".join([self._signature(), *_canonical(self.head, "head"), *_canonical(self.body, "body")])
        return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little")

    def _signature(self) -> str:
        return f"straitlink.dccl.1 {self.name} id={self.id_wire}/{self.id_bits} {self.options.codec_version}"


def load_schema(
    descriptor: Descriptor, codecs: FieldCodecs, models: Mapping[str, ModelInUse], is_strict: bool
) -> Schema:
    """Check a root message and lay it out; SchemaError says what DCCL, or this implementation, refuses.

    is_strict: whether the arithmetic codec raises for values beyond its model.
    """
    options = root_options(descriptor)
    _require_proto2(descriptor)
    builder = _Builder(descriptor, options, codecs, models, is_strict)
    schema = Schema(descriptor, options, builder.message("head"), builder.message("body"))
    for field in schema.head.fields:
        _require_fixed_size(schema.name, field)
    if options.max_bytes is not None and schema.max_bytes > options.max_bytes:
        raise SchemaError(
            f"{schema.name} takes up to {schema.max_bytes} bytes, more than its"
            f" (dccl.msg).max_bytes = {options.max_bytes}"
        )
    return schema


class _Builder:
    def __init__(
        self,
        root: Descriptor,
        options: MessageOptions,
        codecs: FieldCodecs,
        models: Mapping[str, ModelInUse],
        is_strict: bool,
    ) -> None:
        self._root = root
        self._group = options.codec_group
        self._version = options.codec_version or 4
        self._codecs = codecs
        self._models = models
        self._is_strict = is_strict

    def message(self, part: Part) -> Message:
        return self._message(self._root, "", part, None, (self._root.full_name,))

    def _message(
        self, descriptor: Descriptor, prefix: str, part: Part, current: Part | None, within: tuple[str, ...]
    ) -> Message:
        fields = []
        for declared in descriptor.fields:
            options = field_options(declared)
            if options.omit:
                continue
            name = codec_name(declared, options, self._group, self._version, self._codecs)
            if self._is_in(part, current, declared, options, name):
                field = self._field(declared, options, name, prefix, part, current, within)
                if field is not None:
                    fields.append(field)
        oneofs = _oneofs(descriptor) if part == "body" else ()
        if oneofs and self._version < 4:
            raise SchemaError(
                f"{descriptor.full_name}: oneof {oneofs[0].name} needs codec_version 4;"
                f" {self._root.full_name} has {self._version}"
            )
        return Message(descriptor, tuple(fields), oneofs)

    def _is_in(
        self,
        part: Part,
        current: Part | None,
        declared: FieldDescriptor,
        options: FieldOptions,
        name: CodecName,
    ) -> bool:
        if current is not None:
            return current == part
        if self._version == 2 and name.is_default_message:
            return True  # entered for both parts, so that nested in_head fields are found
        return (part == "head") == bool(options.in_head)

    def _field(
        self,
        declared: FieldDescriptor,
        options: FieldOptions,
        name: CodecName,
        prefix: str,
        part: Part,
        current: Part | None,
        within: tuple[str, ...],
    ) -> Field | None:
        self._check(declared, options, part)
        embedded = None
        if name.is_default_message:
            embedded = self._embedded(declared, options, prefix, part, current, within)
            if embedded.is_empty and part == "head":
                return None
            if part == "head" and declared.is_repeated and options.in_head is None:
                raise SchemaError(
                    f"{declared.full_name}: in_head fields within a repeated message are not supported"
                )
        field = self._bind(declared, options, name, prefix, embedded, is_required=False)
        if options.conditions is None:
            return field
        if isinstance(field.wire, CustomWire | OwnWire):
            raise SchemaError(f"{declared.full_name}: codec {name.text} cannot have dynamic_conditions")
        required = self._bind(declared, options, name, prefix, embedded, is_required=True)
        return replace(field, conditions=options.conditions, when_required=required)

    def _bind(
        self,
        declared: FieldDescriptor,
        options: FieldOptions,
        name: CodecName,
        prefix: str,
        embedded: Message | None,
        is_required: bool,
    ) -> Field:
        is_member = declared.containing_oneof is not None
        is_required = is_required or self._is_required(declared)
        wire, has_presence_bit = bind_wire(
            declared, options, name, is_required, embedded, self._models, self._is_strict
        )
        low = high = None
        count_bits = 0
        if declared.is_repeated:
            low, high = options.min_repeat, _max_repeat(declared, options)
            count_bits = clog2(high - low + 1) if self._version >= 3 else 0
        return Field(
            declared,
            f"{prefix}{declared.name}",
            options,
            name.text,
            wire,
            is_required,
            has_presence_bit,
            low,
            high,
            count_bits if not isinstance(wire, CustomWire | OwnWire) else 0,
            is_padded=declared.is_repeated and self._version == 2,
            is_oneof_member=is_member,
        )

    def _is_required(self, declared: FieldDescriptor) -> bool:
        if declared.is_repeated:
            return self._version >= 3
        return declared.is_required or (self._version >= 4 and declared.containing_oneof is not None)

    def _embedded(
        self,
        declared: FieldDescriptor,
        options: FieldOptions,
        prefix: str,
        part: Part,
        current: Part | None,
        within: tuple[str, ...],
    ) -> Message:
        descriptor = declared.message_type
        assert descriptor is not None  # is_default_message says so
        if descriptor.full_name in within:
            raise SchemaError(f"{declared.full_name}: {descriptor.full_name} contains itself; DCCL cannot")
        if options.in_head is not None:
            current = "head" if options.in_head else "body"
        path = f"{prefix}{declared.name}{'[]' if declared.is_repeated else ''}."
        return self._message(descriptor, path, part, current, (*within, descriptor.full_name))

    def _check(self, declared: FieldDescriptor, options: FieldOptions, part: Part) -> None:
        name = declared.full_name
        if declared.name in _METHODS:
            raise SchemaError(
                f"{name} hides the method of that name of protobuf's messages; rename the field"
            )
        if declared.message_type is not None and declared.message_type.GetOptions().map_entry:
            raise SchemaError(f"{name} is a map, which has no order on the wire; use a repeated message")
        if options.conditions is not None and self._version < 3:
            raise SchemaError(f"{name}: dynamic_conditions need codec_version 3 or 4, not {self._version}")
        if options.min_repeat and self._version < 3:
            raise SchemaError(f"{name}: min_repeat needs codec_version 3 or 4, not {self._version}")
        if options.conditions is not None and options.min_repeat:
            raise SchemaError(f"{name}: min_repeat and dynamic_conditions together are not supported")
        if part == "head" and declared.containing_oneof is not None:
            raise SchemaError(f"{name} is in the head and in a oneof; a oneof is always in the body")


def _require_proto2(descriptor: Descriptor) -> None:
    for field in descriptor.fields:
        if not field.is_repeated and not field.has_presence:
            raise SchemaError(
                f"{field.full_name} cannot be unset (proto3 without `optional`); DCCL 2 to 4 read proto2"
            )


def _require_fixed_size(message: str, field: Field) -> None:
    low, high = field.size
    if low != high:
        raise SchemaError(
            f"{message}.{field.path} takes {low} to {high} bits; fields in the head must have a fixed size"
        )
    if isinstance(field.wire, MessageWire):
        for inner in field.wire.message.fields:
            _require_fixed_size(message, inner)


def _oneofs(descriptor: Descriptor) -> tuple[OneOf, ...]:
    return tuple(
        OneOf(oneof.name, tuple(f.name for f in oneof.fields), clog2(len(oneof.fields) + 1))
        for oneof in descriptor.oneofs
    )


def _max_repeat(declared: FieldDescriptor, options: FieldOptions) -> int:
    if options.max_repeat is None:
        raise SchemaError(f"{declared.full_name} is repeated: state (dccl.field).max_repeat")
    if options.max_repeat < 1:
        raise SchemaError(f"{declared.full_name}: max_repeat = {options.max_repeat} must be at least 1")
    if options.min_repeat > options.max_repeat:
        raise SchemaError(
            f"{declared.full_name}: min_repeat = {options.min_repeat} exceeds"
            f" max_repeat = {options.max_repeat}"
        )
    return options.max_repeat


def _bytes(bits: int) -> int:
    return (bits + 7) // 8


def _what(wire: Wire) -> str:
    if isinstance(wire, NumberWire | TimeWire | EnumWire):
        n = wire.numeric
        bounds = f"{n.number_type} {n.minimum!r} {n.maximum!r} {n.resolution!r} {n.is_required} {n.bits}"
        names = sorted(wire.numbers.items()) if isinstance(wire, EnumWire) else ""
        return f"{type(wire).__name__} {bounds} {names}"
    return repr(wire)


def _canonical(message: Message, part: Part) -> list[str]:
    lines = [f"{part} oneof {oneof.name} {' '.join(oneof.members)}" for oneof in message.oneofs]
    for field in message.fields:
        wire = field.wire
        if isinstance(wire, MessageWire):
            what = f"message {wire.message.descriptor.full_name}"
        elif isinstance(wire, CustomWire):
            what = f"{field.codec_name} {wire.size}"
        else:
            what = _what(wire)
        lines.append(
            f"{part} {field.path} {what} {field.is_required} {field.has_presence_bit}"
            f" {field.min_repeat} {field.max_repeat} {field.conditions}"
        )
        if isinstance(wire, MessageWire):
            lines.extend(_canonical(wire.message, part))
    return lines

"""A schema's bit budget as a table."""

from __future__ import annotations

from dataclasses import dataclass

from messages.dccl.fields import (
    BoolWire,
    EnumWire,
    Field,
    Message,
    MessageWire,
    NumberWire,
    OwnWire,
    Part,
    TextWire,
    TimeWire,
)
from messages.dccl.schema import Schema

_TYPE_NAMES = (
    "", "double", "float", "int64", "uint64", "int32", "fixed64", "fixed32", "bool", "string", "group",
    "message", "bytes", "uint32", "enum", "sfixed32", "sfixed64", "sint32", "sint64",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class FieldInfo:
    """One row. minimum, maximum, resolution: in `unit`, None where the field has none.

    min_bits, max_bits: with presence bit, length prefix and all elements; of an embedded message, with all
    its fields, which follow in rows of their own.
    """

    path: str
    type_name: str
    codec: str
    part: Part
    minimum: float | None
    maximum: float | None
    resolution: float | None
    unit: str
    min_bits: int
    max_bits: int
    description: str


@dataclass(frozen=True, slots=True)
class SchemaInfo:
    """The bit budget of one message type."""

    name: str
    message_id: int | None
    codec_version: int
    id_bits: int
    fields: tuple[FieldInfo, ...]
    head_bytes: int
    min_bytes: int
    max_bytes: int
    max_bytes_allowed: int

    def __str__(self) -> str:
        header = ("field", "type", "bounds", "resolution", "unit", "bits")
        rows = [header, ("(id)", "", "", "", "", str(self.id_bits)), *map(_row, self.fields)]
        widths = [max(len(row[i]) for row in rows) for i in range(len(header))]
        lines = [
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows
        ]
        identity = "no id" if self.message_id is None else f"id {self.message_id}"
        size = _range(self.min_bytes, self.max_bytes)
        title = f"{self.name}: {identity}, DCCL codec version {self.codec_version}"
        total = f"total {size} bytes, of at most {self.max_bytes_allowed}; head {self.head_bytes}"
        return "\n".join([title, *(line.rstrip() for line in lines), total])


def describe(schema: Schema) -> SchemaInfo:
    """The bit budget of a schema."""
    options = schema.options
    return SchemaInfo(
        schema.name,
        None if options.omit_id else options.message_id,
        options.codec_version or 0,
        schema.id_bits,
        (*_rows(schema.head, "head"), *_rows(schema.body, "body")),
        schema.head_bytes,
        schema.min_bytes,
        schema.max_bytes,
        options.max_bytes or 0,
    )


def _rows(message: Message, part: Part) -> list[FieldInfo]:
    rows = [
        FieldInfo(
            f"({o.name})", "oneof", "", part, None, None, None, "", o.bits, o.bits, "which member is set"
        )
        for o in message.oneofs
    ]
    for field in message.fields:
        rows.append(_field_info(field, part))
        if isinstance(field.wire, MessageWire):
            rows.extend(_rows(field.wire.message, part))
    return rows


def _field_info(field: Field, part: Part) -> FieldInfo:
    low, high, resolution = _bounds(field)
    return FieldInfo(
        field.path,
        _type_name(field),
        field.codec_name,
        part,
        low,
        high,
        resolution,
        field.options.unit or ("s" if isinstance(field.wire, TimeWire) else ""),
        *field.size,
        field.options.description,
    )


def _bounds(field: Field) -> tuple[float | None, float | None, float | None]:
    wire = field.wire
    if isinstance(wire, NumberWire | TimeWire):
        return wire.numeric.minimum, wire.numeric.maximum, wire.numeric.resolution
    if isinstance(wire, OwnWire) and wire.codec.shown is not None:
        return wire.codec.shown
    if isinstance(wire, EnumWire):
        return wire.numeric.minimum, wire.numeric.maximum, None
    if isinstance(wire, BoolWire):
        return 0, 1, None
    if isinstance(wire, TextWire):
        return (wire.max_length if wire.is_fixed else 0), wire.max_length, None
    return None, None, None


def _type_name(field: Field) -> str:
    declared = field.descriptor
    if declared.message_type is not None:
        name = declared.message_type.name
    elif declared.enum_type is not None:
        name = declared.enum_type.name
    else:
        name = _TYPE_NAMES[declared.type]
    if field.max_repeat is None:
        return f"{name}" if field.is_required else f"{name}?"
    return f"{name}[{_range(field.min_repeat or 0, field.max_repeat)}]"


def _row(field: FieldInfo) -> tuple[str, ...]:
    bounds = "" if field.minimum is None else f"{field.minimum:.10g} .. {field.maximum:.10g}"
    resolution = "" if field.resolution is None else f"{field.resolution:.10g}"
    bits = _range(field.min_bits, field.max_bits)
    return field.path, field.type_name, bounds, resolution, field.unit, bits


def _range(low: int, high: int) -> str:
    return str(low) if low == high else f"{low}..{high}"

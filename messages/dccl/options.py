"""DCCL's options of messages and fields, read from descriptors of any pool."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

from google.protobuf import descriptor_pb2
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.message import Message as ProtobufMessage

from messages.dccl.errors import SchemaError
from messages.proto.dccl import option_extensions_pb2 as extensions
from messages.proto.dccl import straitlink_extensions_pb2 as own_extensions


@dataclass(frozen=True, slots=True)
class Conditions:
    """Lua expressions of a field; None where the field has none of that kind."""

    required_if: str | None
    omit_if: str | None
    only_if: str | None
    minimum: str | None
    maximum: str | None


@dataclass(frozen=True, slots=True)
class ExactOptions:
    """[straitlink.exact] of one field: numbers as text; None where the option is not set."""

    minimum: str | None
    maximum: str | None
    resolution: str | None
    steps: int | None
    per_second: int | None


@dataclass(frozen=True, slots=True)
class FieldOptions:
    """(dccl.field) of one field; None where the option is not set."""

    codec: str | None
    omit: bool
    in_head: bool | None
    precision: int | None
    resolution: float | None
    minimum: float | None
    maximum: float | None
    num_days: int
    static_value: str | None
    max_length: int | None
    max_repeat: int | None
    min_repeat: int
    packed_enum: bool
    description: str
    unit: str
    conditions: Conditions | None
    arithmetic_model: str | None
    exact: ExactOptions


@dataclass(frozen=True, slots=True)
class MessageOptions:
    """(dccl.msg) of one message; None where the option is not set."""

    message_id: int | None
    omit_id: bool
    max_bytes: int | None
    codec: str | None
    codec_group: str | None
    codec_version: int | None


def as_descriptor(message_type: type[ProtobufMessage]) -> Descriptor:
    """A class's descriptor; protobuf's stubs leave open which of its implementations it is from."""
    return cast(Descriptor, message_type.DESCRIPTOR)


def field_options(field: FieldDescriptor) -> FieldOptions:
    """The DCCL options of a field, whichever pool it comes from."""
    # Parsed again with our own extension: the field's pool may hold its options as unknown bytes.
    raw = descriptor_pb2.FieldOptions.FromString(field.GetOptions().SerializePartialToString())
    options = raw.Extensions[extensions.field]

    return FieldOptions(
        codec=options.codec if options.HasField("codec") else None,
        omit=options.omit,
        in_head=options.in_head if options.HasField("in_head") else None,
        precision=options.precision if options.HasField("precision") else None,
        resolution=options.resolution if options.HasField("resolution") else None,
        minimum=options.min if options.HasField("min") else None,
        maximum=options.max if options.HasField("max") else None,
        num_days=options.num_days,
        static_value=options.static_value if options.HasField("static_value") else None,
        max_length=options.max_length if options.HasField("max_length") else None,
        max_repeat=options.max_repeat if options.HasField("max_repeat") else None,
        min_repeat=options.min_repeat,
        packed_enum=options.packed_enum,
        description=options.description,
        unit=_unit(options),
        conditions=_conditions(options),
        arithmetic_model=options.Extensions[extensions.arithmetic].model
        if options.HasExtension(extensions.arithmetic)
        else None,
        exact=_exact(options),
    )


def message_options(message: Descriptor) -> MessageOptions:
    """The DCCL options of a message, whichever pool it comes from."""
    raw = descriptor_pb2.MessageOptions.FromString(message.GetOptions().SerializePartialToString())
    options = raw.Extensions[extensions.msg]
    return MessageOptions(
        message_id=options.id if options.HasField("id") else None,
        omit_id=options.omit_id,
        max_bytes=options.max_bytes if options.HasField("max_bytes") else None,
        codec=options.codec if options.HasField("codec") else None,
        codec_group=options.codec_group if options.HasField("codec_group") else None,
        codec_version=options.codec_version if options.HasField("codec_version") else None,
    )


def root_options(message: Descriptor) -> MessageOptions:
    """The options of a message that is to be sent by itself, with the mandatory ones checked."""
    options = message_options(message)
    name = message.full_name
    if options.codec_version is None:
        raise SchemaError(f"{name} has no (dccl.msg).codec_version: state 2, 3 or 4")
    if options.codec_version not in (2, 3, 4):
        raise SchemaError(f"{name}: (dccl.msg).codec_version = {options.codec_version} is not 2, 3 or 4")
    if options.max_bytes is None:
        raise SchemaError(f"{name} has no (dccl.msg).max_bytes: state the most it may take on the wire")
    if options.omit_id:
        return options
    if options.message_id is None:
        raise SchemaError(f"{name} has no (dccl.msg).id: state one of 0 to 32767, or omit_id")
    if not 0 <= options.message_id <= 32767:
        raise SchemaError(f"{name}: (dccl.msg).id = {options.message_id} is not within 0 and 32767")
    return options


def _unit(options: extensions.DCCLFieldOptions) -> str:
    units = options.units
    name = units.unit or units.derived_dimensions or units.base_dimensions
    return f"{units.prefix}{name}" if name else ""


def _conditions(options: extensions.DCCLFieldOptions) -> Conditions | None:
    if not options.HasField("dynamic_conditions"):
        return None
    dynamic = options.dynamic_conditions
    return Conditions(
        required_if=dynamic.required_if if dynamic.HasField("required_if") else None,
        omit_if=dynamic.omit_if if dynamic.HasField("omit_if") else None,
        only_if=dynamic.only_if if dynamic.HasField("only_if") else None,
        minimum=dynamic.min if dynamic.HasField("min") else None,
        maximum=dynamic.max if dynamic.HasField("max") else None,
    )


def _exact(options: extensions.DCCLFieldOptions) -> ExactOptions:
    exact = options.Extensions[own_extensions.exact]
    return ExactOptions(
        minimum=exact.min if exact.HasField("min") else None,
        maximum=exact.max if exact.HasField("max") else None,
        resolution=exact.resolution if exact.HasField("resolution") else None,
        steps=exact.steps if exact.HasField("steps") else None,
        per_second=exact.per_second if exact.HasField("per_second") else None,
    )

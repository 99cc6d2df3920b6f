"""Message types declared in a few lines, each in a descriptor pool of its own, without protoc."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import Message

from messages.proto.dccl import option_extensions_pb2 as extensions
from messages.proto.dccl import straitlink_extensions_pb2 as own_extensions

F = descriptor_pb2.FieldDescriptorProto


@dataclass
class Declared:
    """One field. options: of (dccl.field). oneof: the name of the oneof that it is in."""

    name: str
    type_name: str
    label: str = "required"
    options: dict[str, Any] = field(default_factory=dict)
    message: Sequence[Declared] = ()
    enum: Sequence[tuple[str, int]] = ()
    oneof: str = ""


def number(
    name: str, low: float, high: float, type_name: str = "double", label: str = "required", **more: Any
) -> Declared:
    """A bounded number."""
    return Declared(name, type_name, label, {"min": low, "max": high, **more})


def declare(*fields: Declared, version: int = 4, **options: Any) -> type[Message]:
    """A root message "test.T" with id 5 and room enough, unless the options say otherwise."""
    given = {"codec_version": version, "id": 5, "max_bytes": 10_000, **options}
    file = descriptor_pb2.FileDescriptorProto(name="test.proto", package="test", syntax="proto2")
    message = file.message_type.add(name="T")
    for name, value in given.items():
        if value is not None:
            setattr(message.options.Extensions[extensions.msg], name, value)
    _fill(message, fields, ".test.T")
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("test.T"))


def _fill(message: descriptor_pb2.DescriptorProto, fields: Sequence[Declared], path: str) -> None:
    oneofs: list[str] = []
    for i, declared in enumerate(fields, 1):
        made = message.field.add(name=declared.name, number=i)
        made.label = getattr(F, f"LABEL_{declared.label.upper()}")
        made.type = getattr(F, f"TYPE_{declared.type_name.upper()}")
        nested = f"N{i}"
        if declared.type_name == "message":
            made.type_name = f"{path}.{nested}"
            _fill(message.nested_type.add(name=nested), declared.message, made.type_name)
        if declared.type_name == "enum":
            made.type_name = f"{path}.{nested}"
            enum = message.enum_type.add(name=nested)
            for name, value in declared.enum:
                enum.value.add(name=f"{nested}_{name}", number=value)
        if declared.oneof:
            if declared.oneof not in oneofs:
                oneofs.append(declared.oneof)
                message.oneof_decl.add(name=declared.oneof)
            made.oneof_index = oneofs.index(declared.oneof)
        _set_options(made.options.Extensions[extensions.field], declared.options)


def _set_options(target: Message, options: dict[str, Any]) -> None:
    for name, value in options.items():
        if name == "arithmetic":
            target.Extensions[extensions.arithmetic].model = value  # type: ignore[attr-defined]
        elif name == "exact":
            _set_options(target.Extensions[own_extensions.exact], value)  # type: ignore[attr-defined]
        elif isinstance(value, dict):
            _set_options(getattr(target, name), value)
        else:
            setattr(target, name, value)
    if not options:
        target.SetInParent()

"""A request's fields against the bounds that its .proto file declares."""

from __future__ import annotations

from typing import Any

from google.protobuf.message import Message

from messages.proto.dccl import option_extensions_pb2
from perception_server.errors import RequestError


def check_bounds(request: Message, where: str = "") -> None:
    """Raise RequestError for the first field outside of its (dccl.field) bounds, or an unknown value."""
    for descriptor, value in request.ListFields():
        declared: Any = descriptor.GetOptions().Extensions[option_extensions_pb2.field]
        name = f"{where}{descriptor.name}"
        repeated = descriptor.is_repeated
        if repeated and declared.HasField("max_repeat") and len(value) > declared.max_repeat:
            raise RequestError(f"{name}: {len(value)} of them: must be at most {declared.max_repeat}")
        for index, item in enumerate(value if repeated else [value]):
            _check(f"{name}[{index}]" if repeated else name, descriptor, declared, item)


def _check(name: str, descriptor: Any, declared: Any, value: Any) -> None:
    if descriptor.message_type is not None:
        check_bounds(value, f"{name}.")
    elif descriptor.enum_type is not None:
        if value not in descriptor.enum_type.values_by_number:
            known = ", ".join(each.name for each in descriptor.enum_type.values)
            raise RequestError(f"{name} = {value}: must be one of {known}")
    elif isinstance(value, str):
        if len(value.encode()) > declared.max_length:
            raise RequestError(f"{name} = {value[:40]!r}...: must be at most {declared.max_length} bytes")
    elif isinstance(value, bool) or not declared.HasField("max"):
        return
    elif not declared.min <= value <= declared.max:  # so is NaN
        raise RequestError(f"{name} = {value:g}: must be within {declared.min:g}..{declared.max:g}")

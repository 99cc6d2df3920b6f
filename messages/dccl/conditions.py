"""Dynamic conditions: DCCL's Lua expressions over the message, run by lupa.

The scripts are part of a schema. They see `this` (the innermost message), `root` and `this_index`
(1-based) as plain tables with enums as strings, and none of Lua's libraries that touch the system.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message as ProtobufMessage

from messages.dccl.errors import DcclError, SchemaError
from messages.dccl.fields import Field, NumberWire
from messages.dccl.numeric import Numeric, make_numeric

_FORBIDDEN = (
    "os",
    "io",
    "package",
    "require",
    "dofile",
    "loadfile",
    "load",
    "debug",
    "python",
    "collectgarbage",
)


class ConditionError(DcclError):
    """A condition's script failed on a message; encoding and decoding turn it into their own error."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """What the conditions say of a field. numeric: its bounds where a script set them, else None."""

    is_omitted: bool
    is_required: bool
    numeric: Numeric | None


class FieldConditions:
    """The compiled conditions of one field."""

    def __init__(self, field: Field) -> None:
        conditions = field.conditions
        assert conditions is not None  # the caller has such a field
        lua = _new_lua(field.descriptor.full_name)
        self._name = field.descriptor.full_name
        self._lua = lua
        self._field = field

        def compiled(what: str, script: str | None) -> Callable[..., Any] | None:
            return None if script is None else _compile(lua, f"{self._name}: {what}", script)

        self._required_if = compiled("required_if", conditions.required_if)
        self._omit_if = compiled("omit_if", conditions.omit_if)
        self._only_if = compiled("only_if", conditions.only_if)
        self._minimum = compiled("min", conditions.minimum)
        self._maximum = compiled("max", conditions.maximum)
        if (self._minimum or self._maximum) and not isinstance(field.wire, NumberWire):
            raise SchemaError(f"{self._name}: dynamic min and max are for numbers")

    def evaluate(self, root: ProtobufMessage, this: ProtobufMessage, index: int) -> Outcome:
        """Run the scripts. index: 1-based in a repeated field, else 0. ConditionError where one fails."""
        tables = [self._table(this), self._table(root), index]
        is_only = self._only_if is not None and self._is_true(self._only_if, tables)
        if (self._only_if is not None and not is_only) or self._is_true(self._omit_if, tables):
            return Outcome(True, False, None)
        is_required = self._field.is_required or is_only or self._is_true(self._required_if, tables)
        return Outcome(False, is_required, self._bounds(tables, is_required))

    def _bounds(self, tables: list[Any], is_required: bool) -> Numeric | None:
        if self._minimum is None and self._maximum is None:
            return None
        wire = self._field.wire
        assert isinstance(wire, NumberWire)  # checked when compiled
        static = wire.numeric
        low = static.minimum if self._minimum is None else self._number(self._minimum, tables)
        high = static.maximum if self._maximum is None else self._number(self._maximum, tables)
        low = min(max(low, static.minimum), static.maximum)
        high = min(max(high, static.minimum), static.maximum)
        if low > high:
            raise ConditionError(f"{self._name}: its scripts set min = {low:g} above max = {high:g}")
        return _numeric(static.number_type, low, high, static.resolution, is_required)

    def _is_true(self, script: Callable[..., Any] | None, tables: list[Any]) -> bool:
        return script is not None and bool(self._run(script, tables))

    def _number(self, script: Callable[..., Any], tables: list[Any]) -> float:
        value = self._run(script, tables)
        if not isinstance(value, int | float) or value != value:
            raise ConditionError(f"{self._name}: a script for its bounds gave {value!r}, not a number")
        return float(value)

    def _run(self, script: Callable[..., Any], tables: list[Any]) -> Any:
        try:
            return script(*tables)
        except Exception as error:  # lupa.LuaError, and whatever its conversions raise
            raise ConditionError(f"{self._name}: its dynamic condition failed: {error}") from error

    def _table(self, message: ProtobufMessage) -> Any:
        return self._lua.table_from(_as_mapping(message), recursive=True)


@lru_cache(maxsize=4096)
def _numeric(number_type: Any, low: float, high: float, resolution: float, is_required: bool) -> Numeric:
    return make_numeric(number_type, low, high, resolution, is_required)


def _new_lua(field: str) -> Any:
    try:
        lupa = importlib.import_module("lupa.lua53")
    except ImportError:
        try:
            lupa = importlib.import_module("lupa")
        except ImportError as error:
            raise SchemaError(
                f"{field} has dynamic_conditions, which are Lua: install straitlink[lua] (lupa)"
            ) from error
    lua = lupa.LuaRuntime(
        register_eval=False,
        register_builtins=False,
        unpack_returned_tuples=True,
        attribute_filter=_no_attribute,
    )
    for name in _FORBIDDEN:
        lua.globals()[name] = None
    return lua


def _no_attribute(_object: object, _name: object, _is_setting: bool) -> object:
    raise AttributeError("scripts see tables only")


def _compile(lua: Any, what: str, script: str) -> Callable[..., Any]:
    body = script if "return" in script.split() else f"return {script}"
    try:
        return lua.eval(f"function(this, root, this_index) {body}\nend")  # type: ignore[no-any-return]
    except Exception as error:  # lupa.LuaSyntaxError has no common base in all of lupa's modules
        raise SchemaError(f"{what} = {script!r} is not Lua: {error}") from error


def _as_mapping(message: ProtobufMessage) -> dict[str, Any]:
    table: dict[str, Any] = {}
    for field, value in message.ListFields():
        convert = _converter(field)
        table[field.name] = [convert(v) for v in value] if field.is_repeated else convert(value)
    return table


def _converter(field: FieldDescriptor) -> Callable[[Any], Any]:
    if field.message_type is not None:
        return _as_mapping
    if field.enum_type is not None:
        names = {value.number: value.name for value in field.enum_type.values}
        return lambda number: names.get(number, number)
    return lambda value: value

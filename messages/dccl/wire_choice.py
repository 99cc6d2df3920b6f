"""Which codec a field has, and what its options make of it. One function for each kind of field."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NoReturn

from google.protobuf.descriptor import FieldDescriptor

from messages.dccl.arithmetic import BoundArithmetic, ModelInUse
from messages.dccl.custom import FieldCodec, FieldCodecs
from messages.dccl.errors import SchemaError
from messages.dccl.fields import (
    BoolWire,
    CustomWire,
    EnumWire,
    HashWire,
    Message,
    MessageWire,
    NumberWire,
    OwnWire,
    StaticWire,
    TextWire,
    TimeWire,
    Wire,
)
from messages.dccl.numeric import NUMBER_TYPES, clog2, make_numeric, type_bounds
from messages.dccl.options import FieldOptions, message_options
from messages.dccl.straitlink.choice import GROUP, OWN, QUATERNION, bind_own

DAY_S = 86400
_MAX_STEPS = 2.0**53  # what a double tells apart

_FAMILIES = {
    "dccl.default": (2, 3, 4),
    "dccl.time": (2, 3, 4),
    "dccl.static": (2, 3, 4),
    "dccl.presence": (3, 4),
    "dccl.var_bytes": (3, 4),
    "dccl.hash": (2, 3, 4),
    "dccl.arithmetic": (2, 3, 4),
}
_ALIASES = {"_time": "dccl.time", "_static": "dccl.static", "_arithmetic": "dccl.arithmetic"}


@dataclass(frozen=True, slots=True)
class CodecName:
    """A field's codec: one of DCCL's families with a version, or one that was handed to the codec."""

    text: str
    family: str
    version: int
    custom: FieldCodec | None
    is_message: bool

    @property
    def is_default_message(self) -> bool:
        """Whether the field is an embedded message in DCCL's own form."""
        return self.is_message and self.custom is None and self.family in ("dccl.default", "dccl.presence")


def codec_name(
    field: FieldDescriptor, options: FieldOptions, group: str | None, version: int, codecs: FieldCodecs
) -> CodecName:
    """Look a field's codec up, as DCCL does: field, then message type, then group, then the default."""
    is_message = field.message_type is not None
    name = options.codec
    if name is None and field.message_type is not None:
        name = message_options(field.message_type).codec
    name = name or group or "dccl.default"
    candidates = [name] if name[-1].isdigit() else [f"{name}{version}", name]
    for candidate in candidates:
        custom = codecs.get(candidate)
        if custom is not None:
            if custom.bind(field, options) is None:
                return CodecName(f"dccl.default{version}", "dccl.default", version, None, is_message)
            return CodecName(candidate, candidate, version, custom, is_message)
    if name in OWN:
        return _own_name(field, name, version)
    for candidate in candidates:
        family = candidate.rstrip("0123456789")
        number = int(candidate[len(family) :] or version)
        family = _ALIASES.get(family, family)
        if number in _FAMILIES.get(family, ()):
            return CodecName(f"{family}{number}", family, number, None, is_message)
    known = ", ".join(sorted([*_FAMILIES, *OWN, *codecs]))
    raise SchemaError(
        f"{field.full_name}: codec {name!r} is not known with codec_version {version}; known are {known}"
    )


def _own_name(field: FieldDescriptor, name: str, version: int) -> CodecName:
    """One of straitlink.1's codecs; in its group, all but numbers are as in DCCL's version 4."""
    if version < 4:
        raise SchemaError(f"{field.full_name}: codec {name} needs codec_version 4, not {version}")
    if name == GROUP and field.cpp_type not in NUMBER_TYPES:
        return CodecName(name, "dccl.default", 4, None, field.message_type is not None)
    if field.message_type is not None and name != QUATERNION:
        raise SchemaError(f"{field.full_name}: codec {name} is for numbers")
    return CodecName(name, name, version, None, field.message_type is not None)


def bind_wire(
    field: FieldDescriptor,
    options: FieldOptions,
    name: CodecName,
    is_required: bool,
    embedded: Message | None,
    models: Mapping[str, ModelInUse],
    is_strict: bool,
) -> tuple[Wire, bool]:
    """The field's form on the wire, and whether a presence bit precedes it; SchemaError if it has none."""
    if name.custom is not None:
        bound = name.custom.bind(field, options)
        assert bound is not None  # codec_name has asked
        return CustomWire(bound), False
    if name.family in OWN:
        return OwnWire(bind_own(field, options, name.family, is_required)), False
    if embedded is not None:
        return MessageWire(embedded), name.version >= 3 and not is_required
    if name.family == "dccl.arithmetic":
        return _arithmetic(field, options, models, is_strict), False
    if name.family == "dccl.static":
        return _static(field, options), False
    if name.family == "dccl.hash":
        return _hash(field, options), False
    if name.family == "dccl.time":
        return _time(field, options, is_required), False
    if name.family == "dccl.presence" and not is_required:
        return _default(field, options, name, True), True
    if _is_text(field):
        return _text(field, options, name, is_required)
    return _default(field, options, name, is_required), False


def _default(field: FieldDescriptor, options: FieldOptions, name: CodecName, is_required: bool) -> Wire:
    if _is_text(field):
        return _text(field, options, name, is_required)[0]
    if name.family == "dccl.var_bytes":
        _fail(field, f"codec {name.text} is for string and bytes")
    if field.cpp_type == FieldDescriptor.CPPTYPE_BOOL:
        return BoolWire(is_required)
    if field.cpp_type == FieldDescriptor.CPPTYPE_ENUM:
        return _enum(field, options, name, is_required)
    return _number(field, options, is_required)


def _number(field: FieldDescriptor, options: FieldOptions, is_required: bool) -> NumberWire:
    number_type = NUMBER_TYPES[field.cpp_type]
    low, high = options.minimum, options.maximum
    if low is None or high is None:
        _fail(field, "a number needs (dccl.field).min and (dccl.field).max")
    if low > high:
        _fail(field, f"min = {low:g} exceeds max = {high:g}")
    if options.precision is not None and options.resolution is not None:
        _fail(field, "precision and resolution exclude each other")
    resolution = _resolution(field, options, 0.0)
    type_low, type_high = type_bounds(number_type)
    if not (type_low <= low <= high <= type_high and math.isfinite(low) and math.isfinite(high)):
        _fail(field, f"min = {low:g} and max = {high:g} must be values of {number_type}")
    if (high - low) / resolution > _MAX_STEPS:
        _fail(field, f"{low:g} to {high:g} in steps of {resolution:g} are more than 2^53 values")
    if options.resolution is not None:
        for bound, what in ((low, "min"), (high, "max")):
            nearest = round(bound / resolution) * resolution
            if abs(bound - nearest) > 1e-10:
                _fail(field, f"{what} = {bound:g} is not a multiple of resolution = {resolution:g}")
    return NumberWire(make_numeric(number_type, low, high, resolution, is_required))


def _resolution(field: FieldDescriptor, options: FieldOptions, shift: float) -> float:
    if options.precision is not None:
        try:
            resolution = math.pow(10.0, -(options.precision + shift))
        except OverflowError:
            resolution = math.inf
    else:
        resolution = 1.0 if options.resolution is None else options.resolution
    if not 0 < resolution < math.inf:
        _fail(field, f"the resolution = {resolution:g} must be greater than 0 and finite")
    return resolution


def _enum(field: FieldDescriptor, options: FieldOptions, name: CodecName, is_required: bool) -> EnumWire:
    assert field.enum_type is not None  # the caller has looked
    values = list(field.enum_type.values)
    if options.packed_enum:
        numeric = make_numeric("int32", 0, len(values) - 1, 1.0, is_required)
        return EnumWire(numeric, {index: value.number for index, value in enumerate(values)})
    if name.version < 3:
        _fail(field, "packed_enum: false needs codec_version 3 or 4")
    numbers = sorted({value.number for value in values})
    numeric = make_numeric("int32", numbers[0], numbers[-1], 1.0, is_required)
    return EnumWire(numeric, {number - numbers[0]: number for number in numbers})


def _is_text(field: FieldDescriptor) -> bool:
    return field.cpp_type == FieldDescriptor.CPPTYPE_STRING


def _text(
    field: FieldDescriptor, options: FieldOptions, name: CodecName, is_required: bool
) -> tuple[TextWire, bool]:
    length = options.max_length
    if length is None:
        _fail(field, "a string or bytes field needs (dccl.field).max_length")
    is_string = field.type == FieldDescriptor.TYPE_STRING
    counted = TextWire(is_string, length, clog2(length + 1), empty_is_unset=False)
    if name.version >= 4 or name.family == "dccl.var_bytes":
        return counted, not is_required
    if not is_string:
        return TextWire(False, length, 0, empty_is_unset=False), not is_required
    if name.version >= 3:
        return TextWire(True, length, counted.prefix_bits, empty_is_unset=True), False
    if length > 255:
        _fail(field, f"max_length = {length} exceeds 255, the most that codec_version 2 can count")
    return TextWire(True, length, 8, empty_is_unset=True), False


def _time(field: FieldDescriptor, options: FieldOptions, is_required: bool) -> TimeWire:
    number_type = NUMBER_TYPES.get(field.cpp_type)
    if number_type not in ("double", "int64", "uint64"):
        _fail(field, "dccl.time is for double (seconds), int64 and uint64 (microseconds)")
    if options.num_days < 1:
        _fail(field, f"num_days = {options.num_days} must be at least 1")
    if options.precision is not None and options.resolution is not None:
        _fail(field, "precision and resolution exclude each other")
    conversion = 1.0 if number_type == "double" else 1e6
    window_s = options.num_days * DAY_S
    resolution = _resolution(field, options, math.log10(conversion))
    if window_s / resolution > _MAX_STEPS:
        _fail(field, f"{window_s} s in steps of {resolution:g} s are more than 2^53 values")
    numeric = make_numeric("double", 0.0, float(window_s), resolution, is_required)
    return TimeWire(numeric, conversion, window_s, number_type != "double")


def _hash(field: FieldDescriptor, options: FieldOptions) -> HashWire:
    if field.cpp_type != FieldDescriptor.CPPTYPE_UINT32 or field.is_repeated:
        _fail(field, "dccl.hash is for one uint32")
    maximum = 2**32 - 1 if options.maximum is None else int(options.maximum)
    if options.minimum or maximum & (maximum + 1):
        _fail(field, f"dccl.hash needs min = 0 and max = 2^k - 1, not {maximum}")
    return HashWire(maximum.bit_length())


def _static(field: FieldDescriptor, options: FieldOptions) -> StaticWire:
    text = options.static_value
    if text is None:
        _fail(field, "dccl.static needs (dccl.field).static_value")
    try:
        return StaticWire(_static_value(field, text))
    except (ValueError, KeyError):
        _fail(field, f"static_value = {text!r} is not a value of the field's type")


def _static_value(field: FieldDescriptor, text: str) -> object:
    if field.is_repeated or field.message_type is not None:
        _fail(field, "dccl.static is for one value, not for repeated or embedded ones")
    if field.cpp_type in (FieldDescriptor.CPPTYPE_DOUBLE, FieldDescriptor.CPPTYPE_FLOAT):
        return float(text)
    if field.cpp_type in NUMBER_TYPES:
        value = int(text)
        low, high = type_bounds(NUMBER_TYPES[field.cpp_type])
        if not low <= value <= high:
            raise ValueError(text)
        return value
    if field.cpp_type == FieldDescriptor.CPPTYPE_BOOL:
        return {"true": True, "1": True, "false": False, "0": False}[text]
    if field.enum_type is not None:
        return field.enum_type.values_by_name[text].number
    return text if field.type == FieldDescriptor.TYPE_STRING else text.encode()


def _arithmetic(
    field: FieldDescriptor, options: FieldOptions, models: Mapping[str, ModelInUse], is_strict: bool
) -> CustomWire:
    name = options.arithmetic_model
    if name is None:
        _fail(field, "dccl.arithmetic needs [arithmetic] { model: ... }")
    if name not in models:
        known = ", ".join(sorted(models)) or "none"
        _fail(field, f"the arithmetic model {name!r} was not given to the codec; given are: {known}")
    return CustomWire(BoundArithmetic(field, models[name], options.max_repeat, is_strict))


def _fail(field: FieldDescriptor, what: str) -> NoReturn:
    raise SchemaError(f"{field.full_name}: {what}")

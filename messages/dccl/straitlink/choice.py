"""Which of straitlink.1's codecs a field has, from its options; SchemaError where they make no sense."""

from __future__ import annotations

from fractions import Fraction
from typing import NoReturn

from google.protobuf.descriptor import FieldDescriptor

from messages.dccl.custom import OwnFieldCodec
from messages.dccl.errors import SchemaError
from messages.dccl.numeric import NUMBER_TYPES, NumberType, to_float32, type_bounds
from messages.dccl.options import FieldOptions
from messages.dccl.straitlink.adaptive import AdaptiveVector
from messages.dccl.straitlink.moment import Moment
from messages.dccl.straitlink.number import Range, SteppedNumber, SteppedVector
from messages.dccl.straitlink.orientation import NAMES, Orientation
from messages.dccl.straitlink.quaternion import MAX_ERROR_RAD, MIN_ERROR_RAD, QuaternionSteps
from messages.dccl.straitlink.steps import MAX_COUNT, Steps, as_written, rational

GROUP = "straitlink.1"
QUATERNION = "straitlink.quaternion.1"
TIME = "straitlink.time.1"
ADAPTIVE = "straitlink.adaptive.1"
OWN = (GROUP, QUATERNION, TIME, ADAPTIVE)

_PRECISION_BITS = {"float": 24, "double": 53}
_MAX_LIST_BITS = 1 << 20  # of one list: a megabit is beyond any link that this is for


def bind_own(field: FieldDescriptor, options: FieldOptions, name: str, is_required: bool) -> OwnFieldCodec:
    """The codec of a field. name: one of OWN; GROUP only for numbers."""
    if name == QUATERNION:
        return _orientation(field, options, is_required)
    number_type = NUMBER_TYPES.get(field.cpp_type)
    if number_type is None:
        _fail(field, f"codec {name} is for numbers")
    if name == TIME:
        return _moment(field, options, number_type, is_required)
    bounds = _range(field, options, number_type)
    if not field.is_repeated:
        if name == ADAPTIVE:
            _fail(field, f"codec {ADAPTIVE} is for repeated fields")
        return SteppedNumber(bounds, is_required)
    if options.max_repeat is None or not options.min_repeat <= options.max_repeat:
        _fail(field, "a repeated field needs (dccl.field).max_repeat, of at least 1 and its min_repeat")
    if options.max_repeat * bounds.steps.count.bit_length() > _MAX_LIST_BITS:
        _fail(field, f"up to {options.max_repeat} numbers of {bounds.steps.count} steps are over 2^20 bits")
    vector = SteppedVector(bounds, options.min_repeat, options.max_repeat)
    return AdaptiveVector(vector) if name == ADAPTIVE else vector


def _range(field: FieldDescriptor, options: FieldOptions, number_type: NumberType) -> Range:
    low, high = _bound(field, options, "min"), _bound(field, options, "max")
    if low is None or high is None:
        _fail(field, "a number needs (dccl.field).min and (dccl.field).max")
    if not low <= high:
        _fail(field, f"min = {_show(low)} exceeds max = {_show(high)}")
    resolution = _resolution(field, options, low, high)
    type_low, type_high = type_bounds(number_type)
    if low < type_low or high > type_high:
        bounds = f"min = {_show(low)} and max = {_show(high)}"
        _fail(
            field,
            f"{bounds} must be values of {number_type}; state large ones as text, in [straitlink.exact]",
        )
    if (high - low) / resolution > MAX_COUNT - 1:
        _fail(
            field, f"{_show(low)} to {_show(high)} in steps of {_show(resolution)} are more than 2^64 values"
        )
    is_integer = number_type not in _PRECISION_BITS
    if is_integer:
        if any(x.denominator != 1 for x in (low, high, resolution)):
            numbers = f"min = {_show(low)}, max = {_show(high)} and resolution = {_show(resolution)}"
            _fail(field, f"{numbers} must be integers")
    elif max(abs(low), abs(high)) > resolution * 2 ** (_PRECISION_BITS[number_type] - 2):
        _fail(
            field,
            f"resolution = {_show(resolution)} is finer than a {number_type} can tell apart at its bounds",
        )
    steps = Steps(low, high, resolution, is_integer)
    if is_integer:
        return Range(field.full_name, steps, int(low), int(high))
    nearest = to_float32 if number_type == "float" else float
    return Range(
        field.full_name,
        steps,
        min(float(low), nearest(float(low))),
        max(float(high), nearest(float(high))),
    )


def _resolution(field: FieldDescriptor, options: FieldOptions, low: Fraction, high: Fraction) -> Fraction:
    exact = options.exact
    given = [
        options.precision is not None,
        options.resolution is not None,
        exact.resolution is not None,
        exact.steps is not None,
    ]
    if sum(given) > 1:
        _fail(field, "precision, resolution and steps exclude each other")
    if exact.steps is not None:
        if not (2 <= exact.steps <= MAX_COUNT and low < high):
            _fail(field, f"steps = {exact.steps} must be at least 2, and min less than max")
        return (high - low) / (exact.steps - 1)
    resolution = _bound(field, options, "resolution")
    if options.precision is not None:
        if abs(options.precision) > 100:
            _fail(field, f"precision = {options.precision} is not within -100 and 100")
        resolution = Fraction(10) ** -options.precision
    if resolution is None:
        return Fraction(1)
    if resolution <= 0:
        _fail(field, f"the resolution = {_show(resolution)} must be greater than 0")
    return resolution


def _bound(field: FieldDescriptor, options: FieldOptions, what: str) -> Fraction | None:
    """An exact option, or the one of the same name that DCCL has."""
    text = {"min": options.exact.minimum, "max": options.exact.maximum}.get(what, options.exact.resolution)
    plain = {"min": options.minimum, "max": options.maximum}.get(what, options.resolution)
    if text is not None:
        number = rational(text)
        if number is None:
            _fail(field, f"[straitlink.exact].{what} = {text!r} is not a number such as 0.25 or 1/3")
        if plain is not None:
            _fail(field, f"{what} is stated twice: {plain:g} and {text}")
        return number
    if plain is None:
        return None
    if not abs(plain) <= 1.8e308:
        _fail(field, f"{what} = {plain} must be finite")
    return as_written(plain)


def _orientation(field: FieldDescriptor, options: FieldOptions, is_required: bool) -> Orientation:
    floats = (FieldDescriptor.CPPTYPE_DOUBLE, FieldDescriptor.CPPTYPE_FLOAT)
    message = field.message_type
    if message is not None:
        parts = [message.fields_by_name.get(name) for name in NAMES]
        if (
            field.is_repeated
            or len(message.fields) != 4
            or any(part is None or part.is_repeated or part.cpp_type not in floats for part in parts)
        ):
            _fail(field, f"codec {QUATERNION} needs one message of exactly four numbers x, y, z and w")
    elif not field.is_repeated or field.cpp_type not in floats or options.max_repeat != 4:
        _fail(field, f"codec {QUATERNION} needs repeated double or float with max_repeat 4: x, y, z, w")
    else:
        is_required = options.min_repeat == 4
        if options.min_repeat not in (0, 4):
            _fail(field, f"min_repeat = {options.min_repeat}: a quaternion has 4 elements, or none")
    error_rad = _bound(field, options, "resolution")
    if error_rad is None or not MIN_ERROR_RAD <= error_rad <= MAX_ERROR_RAD:
        _fail(
            field,
            f"resolution = {error_rad} must be the greatest error of the angle,"
            f" {MIN_ERROR_RAD:g} to {MAX_ERROR_RAD:g} rad",
        )
    steps = QuaternionSteps(float(error_rad))
    return Orientation(field.full_name, field, steps, is_required, message is not None)


def _moment(
    field: FieldDescriptor, options: FieldOptions, number_type: NumberType, is_required: bool
) -> Moment:
    if number_type not in ("double", "int64", "uint64") or field.is_repeated:
        _fail(field, f"codec {TIME} is for one double, int64 or uint64")
    is_integer = number_type != "double"
    per_second = options.exact.per_second or (1_000_000 if is_integer else 1)
    window, least = _bound(field, options, "max"), _bound(field, options, "min")
    if window is None or window <= 0 or least:
        _fail(field, "a time needs max: its window in the field's unit; and no min")
    resolution = _resolution(field, options, Fraction(0), window)
    if (window / resolution).denominator != 1 or not 2 <= window / resolution <= MAX_COUNT:
        _fail(
            field,
            f"the window = {_show(window)} must be 2 to 2^64 times the resolution = {_show(resolution)}",
        )
    if is_integer and resolution.denominator != 1:
        _fail(field, f"the resolution = {_show(resolution)} must be an integer, as the field is")
    # 2^31 s is 2038; a double holds steps of 1 us then.
    if not is_integer and resolution < Fraction(1, 10**6) * per_second:
        _fail(
            field,
            f"the resolution = {_show(resolution)} is finer than a double of seconds can hold: use int64",
        )
    low, high = (0, 2**64 - 1) if number_type == "uint64" else (-(2**63), 2**63 - 1)
    return Moment(
        field.full_name, resolution, int(window / resolution), per_second, is_integer, low, high, is_required
    )


def _show(number: Fraction) -> str:
    """As it may stand in a .proto, or rounded where that is long."""
    text = str(number)
    return text if len(text) <= 24 else f"{float(number):g}"


def _fail(field: FieldDescriptor, what: str) -> NoReturn:
    raise SchemaError(f"{field.full_name}: {what}")

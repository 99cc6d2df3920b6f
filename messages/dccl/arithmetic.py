"""DCCL's arithmetic codec: values drawn from a table of bounds, coded by how often each occurs.

The coder is that of Witten, Neal and Cleary (1987), 32 bits wide, in integers.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

from google.protobuf.descriptor import FieldDescriptor

from messages.dccl.errors import DecodeError, EncodeError, SchemaError

_CODE_BITS = 32
_TOP = 2**_CODE_BITS - 1
_HALF = 2 ** (_CODE_BITS - 1)
_QUARTER = 2 ** (_CODE_BITS - 2)
_MAX_TOTAL = 2**30

_CAST_NAN = {
    FieldDescriptor.CPPTYPE_INT32: -(2**31),
    FieldDescriptor.CPPTYPE_INT64: -(2**63),
    FieldDescriptor.CPPTYPE_UINT32: 0,
    FieldDescriptor.CPPTYPE_UINT64: 2**63,
}
_INTEGER_BOUNDS = {
    FieldDescriptor.CPPTYPE_INT32: (-(2**31), 2**31 - 1),
    FieldDescriptor.CPPTYPE_INT64: (-(2**63), 2**63 - 1),
    FieldDescriptor.CPPTYPE_UINT32: (0, 2**32 - 1),
    FieldDescriptor.CPPTYPE_UINT64: (0, 2**64 - 1),
}
_END = -2
_OUT_OF_RANGE = -1


@dataclass(frozen=True, slots=True)
class ArithmeticModel:
    """How often each value occurs. value_bounds: rising, one more than there are frequencies.

    A value v is coded as the symbol of the nearer bound. eof_frequency: of the end of a list that is
    shorter than max_repeat. out_of_range_frequency: 0 ends the list at a value out of range instead.
    """

    name: str
    frequencies: tuple[int, ...]
    value_bounds: tuple[float, ...]
    eof_frequency: int = 1
    out_of_range_frequency: int = 0
    is_adaptive: bool = False

    def __post_init__(self) -> None:
        what = f"arithmetic model {self.name!r}"
        if not self.frequencies or min(self.frequencies) < 1:
            raise SchemaError(f"{what}: each of its frequencies must be at least 1")
        if min(self.eof_frequency, self.out_of_range_frequency) < 0:
            raise SchemaError(f"{what}: eof_frequency and out_of_range_frequency must be at least 0")
        if len(self.value_bounds) != len(self.frequencies) + 1:
            raise SchemaError(
                f"{what} has {len(self.value_bounds)} value_bounds for {len(self.frequencies)} frequencies;"
                " it needs one more"
            )
        if any(not a < b for a, b in zip(self.value_bounds, self.value_bounds[1:], strict=False)):
            raise SchemaError(f"{what}: its value_bounds must rise")
        if self.cumulative()[-1] >= _MAX_TOTAL:
            raise SchemaError(f"{what}: its frequencies add up to {self.cumulative()[-1]}, 2^30 or more")

    def cumulative(self) -> list[int]:
        """Sums of the frequencies of all symbols below: end, out of range, then the values."""
        sums = [0]
        for frequency in (self.eof_frequency, self.out_of_range_frequency, *self.frequencies):
            sums.append(sums[-1] + frequency)
        return sums

    def symbol(self, value: float) -> int:
        """The symbol of a value. The nearer bound is judged by squares, as DCCL does."""
        bounds = self.value_bounds
        if value < bounds[0] or value > bounds[-1]:
            return _OUT_OF_RANGE
        upper = bisect_right(bounds, value)
        lower = upper - 1
        last = len(self.frequencies) - 1
        if upper > last:
            return last
        square = value * value
        is_lower = abs(bounds[lower] ** 2 - square) < abs(bounds[upper] ** 2 - square)
        return lower if is_lower else upper


class ModelInUse:
    """A model with what it has learnt of the messages sent, and of those received.

    The fields of a codec that name the same model share it. What a message teaches counts only once the
    whole message is coded: `begin` before, `commit` after.
    """

    def __init__(self, model: ArithmeticModel) -> None:
        self.model = model
        self._sent = self._received = model.cumulative()
        self.sending = self.receiving = self._sent

    def begin(self) -> None:
        """Forget what an unfinished message taught."""
        self.sending, self.receiving = self._sent, self._received

    def commit(self) -> None:
        """Keep what the message taught."""
        self._sent, self._received = self.sending, self.receiving


class BoundArithmetic:
    """The codec of one field with one model.

    An adaptive model learns from message to message, on each side for itself, as DCCL's does: both sides
    must then code the same messages in the same order, and one lost message spoils all that follow.
    """

    def __init__(
        self, field: FieldDescriptor, use: ModelInUse, max_repeat: int | None, is_strict: bool
    ) -> None:
        model = use.model
        numeric = (
            FieldDescriptor.CPPTYPE_DOUBLE,
            FieldDescriptor.CPPTYPE_FLOAT,
            FieldDescriptor.CPPTYPE_INT32,
            FieldDescriptor.CPPTYPE_INT64,
            FieldDescriptor.CPPTYPE_UINT32,
            FieldDescriptor.CPPTYPE_UINT64,
        )
        if field.cpp_type not in numeric:
            raise SchemaError(f"{field.full_name}: dccl.arithmetic is for numbers")
        if field.is_repeated and not max_repeat:
            raise SchemaError(f"{field.full_name} is repeated: state (dccl.field).max_repeat")
        low, high = model.value_bounds[0], model.value_bounds[-2]
        if field.cpp_type not in numeric[:2]:
            type_low, type_high = _INTEGER_BOUNDS[field.cpp_type]
            if low < type_low or high > type_high:
                raise SchemaError(
                    f"{field.full_name} cannot hold {low:g} to {high:g} of model {model.name!r}"
                )
        self._name = field.full_name
        self._model = model
        self._is_repeated = field.is_repeated
        self._is_float = field.cpp_type in numeric[:2]
        self._max_repeat = (max_repeat or 1) if field.is_repeated else 1
        self._is_strict = is_strict
        self._cpp_type = field.cpp_type
        self.min_bits, self.max_bits = 0, _max_bits(model, self._max_repeat)
        self._use = use

    def __repr__(self) -> str:
        return f"BoundArithmetic({self._model!r}, {self._max_repeat})"

    def encode(self, value: object) -> tuple[int, int]:
        """The bits of a number, or of the list of a repeated field; None for an unset one."""
        values: Sequence[float]
        if self._is_repeated:
            values = value if isinstance(value, Sequence) else []
        else:
            values = [value] if isinstance(value, int | float) else []
        use = self._use
        bits, count, use.sending = _encode_symbols(
            self._symbols(values), use.sending, self._model.is_adaptive
        )
        return bits, count

    def decode(self, bits: int, available: int) -> tuple[object, int]:
        """The number or list at the low end of `bits`, and how many bits it took."""
        symbols, taken, learnt = _decode_symbols(
            bits, self._max_repeat, self._use.receiving, self._model.is_adaptive
        )
        if taken > available:
            raise DecodeError(f"{self._name}: the message ends within its arithmetic code")
        self._use.receiving = learnt
        values = [self._value(symbol) for symbol in symbols if symbol != _END]
        if self._is_repeated:
            return values, taken
        return (values[0] if values else None), taken

    def _symbols(self, values: Sequence[float]) -> list[int]:
        symbols = []
        for value in values[: self._max_repeat]:
            if value != value:
                raise EncodeError(f"{self._name} = {value} is not a number")
            symbol = self._model.symbol(value)
            if symbol == _OUT_OF_RANGE and self._model.out_of_range_frequency == 0:
                if self._is_strict:
                    bounds = self._model.value_bounds
                    raise EncodeError(
                        f"{self._name} = {value} is not within {bounds[0]:g} to {bounds[-1]:g}, the bounds of"
                        f" model {self._model.name!r}"
                    )
                # DCCL ends the list here and writes the rest nevertheless; no decoder can make sense of it.
                symbol = _END
            symbols.append(symbol)
        if len(symbols) < self._max_repeat:
            # Where the end has no frequency, DCCL sends the symbol numbered like the largest frequency.
            end = _END if self._model.eof_frequency else max(self._model.frequencies)
            symbols.extend([_END] if end == _END else [end] * (self._max_repeat - len(symbols)))
            if end >= len(self._model.frequencies):
                raise EncodeError(
                    f"{self._name}: {len(values)} values are fewer than max_repeat = {self._max_repeat}, and"
                    f" model {self._model.name!r} has no frequency for the end"
                )
        return symbols

    def _value(self, symbol: int) -> float | int:
        if symbol == _OUT_OF_RANGE:
            # What C++ makes of NaN in a cast, on the machines where the vectors were written.
            return math.nan if self._is_float else _CAST_NAN[self._cpp_type]
        bound = self._model.value_bounds[symbol]
        return float(bound) if self._is_float else int(bound)


def _max_bits(model: ArithmeticModel, max_repeat: int) -> int:
    if model.is_adaptive:
        return 31 * (max_repeat + 1)  # what it may have learnt is not bounded otherwise
    total = model.cumulative()[-1]
    frequencies = [f for f in (model.out_of_range_frequency, *model.frequencies) if f]
    # The interval is at least 2^30 wide, and division shortens a symbol's share by at most 2.
    dearest = -math.log2(max(min(frequencies) / total - 2.0**-29, 2.0**-31))
    end = -math.log2(model.eof_frequency / total) if model.eof_frequency else 0.0
    return math.ceil(max_repeat * dearest + end) + 2


def _encode_symbols(
    symbols: Sequence[int], cumulative: list[int], is_adaptive: bool
) -> tuple[int, int, list[int]]:
    """The symbols' bits, their number, and the cumulative frequencies afterwards."""
    if is_adaptive:
        cumulative = list(cumulative)
    low, high, follow = 0, _TOP, 0
    bits: list[int] = []

    def emit(bit: int) -> None:
        nonlocal follow
        bits.append(bit)
        bits.extend([1 - bit] * follow)
        follow = 0

    for symbol in symbols:
        low, high = _narrow(low, high, symbol, cumulative)
        if is_adaptive:
            _learn(cumulative, symbol)
        while True:
            if high < _HALF:
                emit(0)
            elif low >= _HALF:
                emit(1)
                low, high = low - _HALF, high - _HALF
            elif low >= _QUARTER and high < 3 * _QUARTER:
                follow += 1
                low, high = low - _QUARTER, high - _QUARTER
            else:
                break
            low, high = 2 * low, 2 * high + 1
    # THE FLUSH: as few bits as leave no doubt, whatever follows.
    if low == 0:
        if high != _TOP or follow > 0:
            emit(0)
    elif high == _TOP:
        emit(1)
    else:
        follow += 1
        emit(0 if low < _QUARTER else 1)
    return sum(bit << i for i, bit in enumerate(bits)), len(bits), cumulative


def _decode_symbols(
    bits: int, max_repeat: int, cumulative: list[int], is_adaptive: bool
) -> tuple[list[int], int, list[int]]:
    """The symbols, how many bits leave no doubt of them, and the cumulative frequencies afterwards."""
    if is_adaptive:
        cumulative = list(cumulative)
    low, high, follow = 0, _TOP, 0
    code = int(f"{bits & _TOP:032b}"[::-1], 2)
    shifted = 0
    symbols: list[int] = []
    while len(symbols) < max_repeat:
        total = cumulative[-1]
        share = ((code - low + 1) * total - 1) // (high - low + 1)
        symbol = bisect_right(cumulative, min(share, total - 1)) - 1 + _END
        symbols.append(symbol)
        low, high = _narrow(low, high, symbol, cumulative)
        if is_adaptive:
            _learn(cumulative, symbol)
        while True:
            if high < _HALF:
                less, follow = 0, 0
            elif low >= _HALF:
                less, follow = _HALF, 0
            elif low >= _QUARTER and high < 3 * _QUARTER:
                less, follow = _QUARTER, follow + 1
            else:
                break
            low, high = 2 * (low - less), 2 * (high - less) + 1
            code = 2 * (code - less) + (bits >> shifted + _CODE_BITS & 1)
            shifted += 1
        if symbol == _END:
            break
    # THE FLUSH, from the other side: the bits after which any continuation stays within low and high.
    needed = 1 if follow else 0
    while (
        code >> (_CODE_BITS - needed) << (_CODE_BITS - needed) < low
        or (code | (1 << (_CODE_BITS - needed)) - 1) > high
    ):
        needed += 1
    return symbols, shifted + needed, cumulative


def _narrow(low: int, high: int, symbol: int, cumulative: Sequence[int]) -> tuple[int, int]:
    span, total = high - low + 1, cumulative[-1]
    below, upto = cumulative[symbol - _END], cumulative[symbol - _END + 1]
    return low + span * below // total, low + span * upto // total - 1


def _learn(cumulative: list[int], symbol: int) -> None:
    if cumulative[-1] >= _MAX_TOTAL - 1:
        return
    for i in range(symbol - _END + 1, len(cumulative)):
        cumulative[i] += 1

"""Many messages of one type at once, as columns of numbers: for logs and measurements.

Only for types whose messages all have the same layout. The work is done by numpy on words of 64 bits, a
column at a time, with the arithmetic of the single-message codec.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from messages.dccl.encoder import Policy
from messages.dccl.errors import DecodeError, EncodeError, SchemaError
from messages.dccl.fields import BoolWire, EnumWire, Field, Message, MessageWire, NumberWire, TimeWire
from messages.dccl.schema import Schema

Columns = Mapping[str, ArrayLike]
_WORD_BITS = 64
_MAX_WIDTH = 53


@dataclass(frozen=True, slots=True)
class _Column:
    """One field: `count` numbers (None for a scalar) of `width` bits from bit `start`."""

    field: Field
    start: int
    width: int
    count: int | None


class Batch:
    """Encodes and decodes whole columns.

    columns: by field path ("pose.x"); scalars of shape (messages,), repeated fields (messages, max_repeat).
    Rows: uint8 of shape (messages, bytes). Enums are their numbers. A repeated field has max_repeat
    elements in each message, and each field is set in each. Numbers out of bounds: as the codec is told,
    without a note; with "dccl", zero bits.
    """

    Rows: TypeAlias = NDArray[np.uint8]
    Column: TypeAlias = NDArray[Any]

    def __init__(self, schema: Schema, policy: Policy) -> None:
        self._schema = schema
        self._policy = policy
        self._columns: list[_Column] = []
        # What all messages have in common: the id, and the counts of repeated fields.
        self._constant = schema.id_wire
        place = self._lay_out(schema.head, schema.id_bits)
        place = self._lay_out(schema.body, 8 * schema.head_bytes)
        self._bytes = (place + 7) // 8
        self._words = (place + _WORD_BITS - 1) // _WORD_BITS + 1

    def encode(self, columns: Columns) -> NDArray[np.uint8]:
        """One row of bytes for each message; EncodeError names field and row of what does not fit."""
        given = {c.field.path for c in self._columns}
        if given != set(columns):
            differing = ", ".join(sorted(given ^ set(columns)))
            raise EncodeError(f"{self._schema.name}: the columns differ from its fields in: {differing}")
        arrays = [(c, self._shaped(c, columns[c.field.path])) for c in self._columns]
        counts = {len(array) for _, array in arrays}
        if len(counts) > 1:
            raise EncodeError(f"{self._schema.name}: the columns have different lengths: {sorted(counts)}")
        words = np.zeros((self._words, counts.pop() if counts else 0), np.uint64)
        for i in range(self._words):
            words[i] = self._constant >> (_WORD_BITS * i) & (2**_WORD_BITS - 1)
        for column, array in arrays:
            wires = self._wires(column, array)
            for i in range(column.count or 1):
                _insert(
                    words, wires[i] if column.count is not None else wires, column.start + i * column.width
                )
        rows = np.ascontiguousarray(words.T).astype("<u8", copy=False).view(np.uint8)
        return np.ascontiguousarray(rows[:, : self._bytes])

    def decode(self, rows: NDArray[np.uint8], now_s: int | None) -> dict[str, NDArray[Any]]:
        """The columns of rows; DecodeError where a row is no message of this layout."""
        if rows.ndim != 2 or rows.shape[1] != self._bytes or rows.dtype != np.uint8:
            raise DecodeError(
                f"{self._schema.name}: rows of {rows.shape} {rows.dtype} are not"
                f" (messages, {self._bytes}) uint8"
            )
        padded = np.zeros((len(rows), self._words * 8), np.uint8)
        padded[:, : self._bytes] = rows
        words = np.ascontiguousarray(padded.view("<u8").T)
        self._check_constant(words)
        return {c.field.path: self._values(c, words, now_s) for c in self._columns}

    def _lay_out(self, message: Message, place: int) -> int:
        if message.oneofs:
            raise self._unsuitable(f"oneof {message.oneofs[0].name}")
        for field in message.fields:
            wire = field.wire
            is_message = isinstance(wire, MessageWire)
            if not isinstance(wire, NumberWire | TimeWire | BoolWire | EnumWire | MessageWire):
                raise self._unsuitable(field.path)
            if field.conditions is not None or (is_message and field.max_repeat is not None):
                raise self._unsuitable(field.path)
            if field.has_presence_bit:
                self._constant |= 1 << place
                place += 1
            if isinstance(wire, MessageWire):
                place = self._lay_out(wire.message, place)
                continue
            if isinstance(wire, BoolWire):
                is_suitable = True
            else:
                is_suitable = wire.numeric.is_affine and wire.numeric.bits <= _MAX_WIDTH
            if not is_suitable:
                raise self._unsuitable(field.path)
            if field.max_repeat is not None:
                self._constant |= (
                    (field.max_repeat - (field.min_repeat or 0)) << place if field.count_bits else 0
                )
                place += field.count_bits
            width = wire.size[0]
            self._columns.append(_Column(field, place, width, field.max_repeat))
            place += width * (1 if field.max_repeat is None else field.max_repeat)
        return place

    def _unsuitable(self, what: str) -> SchemaError:
        return SchemaError(
            f"{self._schema.name}: {what} has no fixed place or is no number; encode its messages one by one"
        )

    def _shaped(self, column: _Column, values: ArrayLike) -> NDArray[Any]:
        array = np.asarray(values)
        shape = array.shape[1:]
        if array.ndim == 0 or shape != (() if column.count is None else (column.count,)):
            expected = "(messages,)" if column.count is None else f"(messages, {column.count})"
            raise EncodeError(f"{column.field.path} has the shape {array.shape}; it must have {expected}")
        return array

    def _wires(self, column: _Column, array: NDArray[Any]) -> NDArray[np.uint64]:
        """Wire integers of a column, elements first: (count, messages) or (messages,)."""
        wire, array = column.field.wire, array.T
        if isinstance(wire, BoolWire):
            return array.astype(bool).astype(np.uint64) + np.uint64(0 if wire.is_required else 1)
        if isinstance(wire, EnumWire):
            return self._enum_wires(column, wire, array)
        assert isinstance(wire, NumberWire | TimeWire)  # as laid out
        n = wire.numeric
        if not n.is_float:
            index = array.astype(np.int64)
            is_outside = (array < n.lowest) | (array > n.highest)
        else:
            values = array.astype(np.float32 if n.number_type == "float" else np.float64).astype(np.float64)
            if isinstance(wire, TimeWire):
                values = np.fmod(values / wire.conversion, float(wire.window_s))
            steps = np.floor((values / n.resolution if n.resolution >= 1 else values * n.inverse) + 0.5)
            is_outside = ~((steps >= n.lowest) & (steps <= n.highest))
            index = np.where(is_outside, 0, steps).astype(np.int64)
        wires = index - (n.origin - n.offset)
        if is_outside.any():
            wires = self._treated(column, array, is_outside, wires)
        return wires.astype(np.uint64)

    def _enum_wires(self, column: _Column, wire: EnumWire, array: NDArray[Any]) -> NDArray[np.uint64]:
        wires = np.full(array.shape, -1, np.int64)
        for index, number in reversed(wire.numbers.items()):
            wires[array == number] = index + wire.numeric.offset
        if (wires < 0).any():
            number = array[wires < 0].flat[0]
            raise EncodeError(f"{column.field.path} = {number} is no value of its enum")
        return wires.astype(np.uint64)

    def _treated(
        self, column: _Column, array: NDArray[Any], is_outside: NDArray[np.bool_], wires: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        wire = column.field.wire
        assert isinstance(wire, NumberWire | TimeWire)  # the caller has looked
        n = wire.numeric
        treatment = self._policy.treatment(column.field.path)
        is_nan = array != array
        if treatment == "raise":
            # A bound that its own rounding puts outside is not the value's fault.
            low, high = n.type_range
            is_noise = is_outside & (array >= low) & (array <= high)
            nearest = np.where(array * 2 < n.minimum + n.maximum, n.first, n.last) - n.origin + n.offset
            wires, is_outside = np.where(is_noise, nearest, wires), is_outside & ~is_noise
            if not is_outside.any():
                return wires
        if treatment == "raise" or (treatment == "clamp" and is_nan.any()):
            at = np.argwhere(is_nan if treatment == "clamp" else is_outside)[0]
            raise EncodeError(
                f"{column.field.path} = {array[tuple(at)]} in row {at[-1]} is not a value within its bounds"
                f" {n.minimum:.10g} to {n.maximum:.10g}"
            )
        if treatment == "dccl":
            return np.where(is_outside, np.where(is_nan, n.offset, 0), wires)
        below, above = n.first - n.origin + n.offset, n.last - n.origin + n.offset
        return np.where(is_outside, np.where(array > n.minimum, above, below), wires)

    def _check_constant(self, words: NDArray[np.uint64]) -> None:
        mask = (1 << 64 * self._words) - 1
        for column in self._columns:
            bits = (1 << column.width * (1 if column.count is None else column.count)) - 1
            mask &= ~(bits << column.start)
        used = (1 << 8 * self._bytes) - 1
        for i in range(self._words):
            word = (mask & used) >> (_WORD_BITS * i) & (2**_WORD_BITS - 1)
            expected = self._constant >> (_WORD_BITS * i) & (2**_WORD_BITS - 1)
            differs = (words[i] & np.uint64(word)) != np.uint64(expected)
            if differs.any():
                raise DecodeError(
                    f"{self._schema.name}: row {int(np.argmax(differs))} has another id, count or"
                    " padding than messages of this layout"
                )

    def _values(self, column: _Column, words: NDArray[np.uint64], now_s: int | None) -> NDArray[Any]:
        wires = np.stack(
            [_extract(words, column.start + i * column.width, column.width) for i in range(column.count or 1)]
        )
        wire, path = column.field.wire, column.field.path
        if column.count == 0:
            wires = wires[:0]
        values: NDArray[Any]
        if isinstance(wire, BoolWire):
            values = wires == (1 if wire.is_required else 2)
        elif isinstance(wire, EnumWire):
            values = _enum_values(path, wire, wires)
        else:
            assert isinstance(wire, NumberWire | TimeWire)  # as laid out
            n = wire.numeric
            index = wires.astype(np.int64) + (n.origin - n.offset)
            if (index < n.origin).any() or (index > n.last).any():
                raise DecodeError(f"{path}: a row has it unset or beyond its bounds")
            values = index
            if n.is_float:
                values = index * n.resolution if n.resolution >= 1 else index / n.inverse
            if n.number_type == "float":
                values = values.astype(np.float32)
            if isinstance(wire, TimeWire):
                values = _times(path, wire, values, now_s)
        return np.ascontiguousarray(values.T) if column.count is not None else values[0]


def _insert(words: NDArray[np.uint64], values: NDArray[np.uint64], place: int) -> None:
    word, shift = divmod(place, _WORD_BITS)
    words[word] |= values << np.uint64(shift)
    if shift and word + 1 < len(words):
        words[word + 1] |= values >> np.uint64(_WORD_BITS - shift)


def _extract(words: NDArray[np.uint64], place: int, width: int) -> NDArray[np.uint64]:
    word, shift = divmod(place, _WORD_BITS)
    values = words[word] >> np.uint64(shift)
    if shift + width > _WORD_BITS:
        values = values | words[word + 1] << np.uint64(_WORD_BITS - shift)
    masked: NDArray[np.uint64] = values & np.uint64((1 << width) - 1)
    return masked


def _enum_values(path: str, wire: EnumWire, wires: NDArray[np.uint64]) -> NDArray[np.int32]:
    table = np.full(1 << wire.numeric.bits, np.iinfo(np.int64).min, np.int64)
    for index, number in wire.numbers.items():
        table[index + wire.numeric.offset] = number
    values = table[wires.astype(np.int64)]
    if (values == np.iinfo(np.int64).min).any():
        raise DecodeError(f"{path}: a row has it unset or beyond its enum")
    return values.astype(np.int32)


def _times(path: str, wire: TimeWire, values: NDArray[Any], now_s: int | None) -> NDArray[Any]:
    if now_s is None:
        raise DecodeError(f"{path} is a dccl.time: decoding it needs now_ns, the receiver's clock")
    window_s = wire.window_s
    today_s = now_s % window_s
    start_s = np.full(values.shape, float(now_s - today_s))
    start_s[values - today_s > window_s // 2] -= window_s
    start_s[today_s - values > window_s // 2] += window_s
    times = wire.conversion * (start_s + values)
    rounded: NDArray[Any] = np.floor(times + 0.5).astype(np.int64) if wire.is_integer else times
    return rounded

"""An adaptive binary range coder: one bit at a time, each at its own probability.

One kernel both writes and reads, so that a model has a single loop which runs in the encoder with the
true bits and in the decoder without them; the two cannot drift apart. Probabilities are those of a one,
in 1/65536, within 1..65535. Source: the 32-bit carry-less coder of M. Mahoney's PAQ family.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .compiled import Ints, inlined, ints, octets
from .errors import DecodeError

PROBABILITY_BITS = 16
MOST_CUT_ZEROS = 4
LOW, HIGH, CODE, POSITION, READING = range(5)
_TOP_BYTE = 0xFF000000
_ALL = 0xFFFFFFFF


@inlined
def code_bit(coder: Ints, data: NDArray[np.uint8], bit: int, p: int) -> int:
    """Write `bit` at probability `p` of a one, or read one and return it; `bit` is then ignored.

    Reading past the end gives zeros and writing past it is dropped; both are found afterwards, by
    `check_end` and `encoded_bytes`, so that the loop needs no errors.
    """
    low = coder[LOW]
    high = coder[HIGH]
    middle = low + ((high - low) * p >> PROBABILITY_BITS)
    if coder[READING]:
        bit = 1 if coder[CODE] <= middle else 0
    if bit:
        high = middle
    else:
        low = middle + 1
    while (low ^ high) & _TOP_BYTE == 0:
        position = coder[POSITION]
        if coder[READING]:
            byte = int(data[position]) if position < len(data) else 0
            coder[CODE] = (coder[CODE] << 8 & _ALL) | byte
        elif position < len(data):
            data[position] = low >> 24
        coder[POSITION] = position + 1
        low = low << 8 & _ALL
        high = (high << 8 & _ALL) | 0xFF
    coder[LOW] = low
    coder[HIGH] = high
    return bit


def encoder(capacity_bytes: int) -> tuple[Ints, NDArray[np.uint8]]:
    """A coder that writes and its buffer; take the bytes with `encoded_bytes`."""
    return ints([0, _ALL, 0, 0, 0]), octets(bytes(capacity_bytes))


def encoded_bytes(coder: Ints, data: NDArray[np.uint8]) -> bytes:
    """What was written. One byte ends it, and up to four zeros are cut, as the reader supplies them.

    Raises OverflowError if the buffer was too small, which a kernel's caller rules out by its size.
    """
    end = int(coder[POSITION])
    if end + 1 > len(data):
        raise OverflowError(f"a coded stream of {end + 1} bytes does not fit its buffer of {len(data)}")
    data[end] = (int(coder[LOW]) >> 24) + 1 if coder[LOW] else 0
    stream = bytes(data[: end + 1])
    return stream[:-MOST_CUT_ZEROS] + stream[-MOST_CUT_ZEROS:].rstrip(b"\0")


def decoder(data: bytes) -> tuple[Ints, NDArray[np.uint8]]:
    """A coder that reads, and the bytes as `code_bit` takes them."""
    code = int.from_bytes(data[:4].ljust(4, b"\0"), "big")
    return ints([0, _ALL, code, 4, 1]), octets(data)


@inlined
def is_exhausted(coder: Ints, data: NDArray[np.uint8]) -> bool:
    """Whether more was read than any writer would have left out, so that a loop can stop early."""
    return bool(coder[READING] and coder[POSITION] - 3 - MOST_CUT_ZEROS > len(data))


def check_end(coder: Ints, data: NDArray[np.uint8]) -> None:
    """Raise DecodeError unless the reader used the stream to its last byte and no further."""
    if is_exhausted(coder, data):
        raise DecodeError(f"the coded stream is cut after {len(data)} bytes")
    used = int(coder[POSITION]) - 3
    if len(data) > used:
        raise DecodeError(f"{len(data) - used} bytes follow the coded stream of {used} bytes")

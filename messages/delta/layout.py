"""The bytes of a delta: which references, the lanes, and a check.

One range code, its first digit in the highest bit of the first byte:

1. the distance to the reference, 0 for none;
2. with a reference, for each of the HISTORY numbers before it, nearest first, whether it is used;
3. with a reference, whether lanes lean on each other;
4. the lanes, in order: by their expectation with a reference, else each as one of its count;
5. the low CHECK_BITS of a CRC-32 of the schema's hash and the lanes.

The code ends with the fewest bytes after which zeros may be read. Bytes that an encoder would not have
chosen for what they decode to are refused, so that the slack of the last byte checks as well.
"""

from __future__ import annotations

import struct
import zlib
from bisect import bisect_right
from itertools import accumulate

from messages.delta.sample import HISTORY, MAX_DISTANCE
from messages.entropy import RangeDecoder, RangeEncoder

CHECK_BITS = 8
_NONE_SHARE = 1 << 13  # of no reference at all: 4 bits
_DISTANCE_SHARES = [_NONE_SHARE, *((1 << 16) // (d + 3) for d in range(1, MAX_DISTANCE + 1))]
_DISTANCE_BELOW = [0, *accumulate(_DISTANCE_SHARES[:-1])]
_DISTANCE_TOTAL = sum(_DISTANCE_SHARES)
_HELD_TOTAL = 16  # the sample before one that is used is so in 15 of 16; before one that is not, in 8

_SAME_TOTAL = 16  # lanes lean or do not as those of the reference, in 15 of 16


def encode_distance(coder: RangeEncoder, distance: int) -> None:
    """How far back the reference is; 0 for none."""
    coder.encode(_DISTANCE_BELOW[distance], _DISTANCE_SHARES[distance], _DISTANCE_TOTAL)


def decode_distance(coder: RangeDecoder) -> int:
    """Undo `encode_distance`."""
    distance = bisect_right(_DISTANCE_BELOW, coder.share(_DISTANCE_TOTAL)) - 1
    coder.take(_DISTANCE_BELOW[distance], _DISTANCE_SHARES[distance])
    return distance


def encode_held(coder: RangeEncoder, held: list[bool]) -> None:
    """Which of the HISTORY numbers before the reference are used."""
    held_share = _HELD_TOTAL - 1
    for is_held in held:
        below, share = (0, held_share) if is_held else (held_share, _HELD_TOTAL - held_share)
        coder.encode(below, share, _HELD_TOTAL)
        held_share = _HELD_TOTAL - 1 if is_held else _HELD_TOTAL // 2


def decode_held(coder: RangeDecoder) -> list[bool]:
    """Undo `encode_held`."""
    held, held_share = [], _HELD_TOTAL - 1
    for _ in range(HISTORY):
        is_held = coder.share(_HELD_TOTAL) < held_share
        coder.take(*((0, held_share) if is_held else (held_share, _HELD_TOTAL - held_share)))
        held.append(is_held)
        held_share = _HELD_TOTAL - 1 if is_held else _HELD_TOTAL // 2
    return held


def encode_leans(coder: RangeEncoder, leans: bool, leant: bool) -> None:
    """Whether lanes lean on each other; leant: whether those of the reference did."""
    coder.encode(*((0, _SAME_TOTAL - 1) if leans == leant else (_SAME_TOTAL - 1, 1)), _SAME_TOTAL)


def decode_leans(coder: RangeDecoder, leant: bool) -> bool:
    """Undo `encode_leans`."""
    is_same = coder.share(_SAME_TOTAL) < _SAME_TOTAL - 1
    coder.take(*((0, _SAME_TOTAL - 1) if is_same else (_SAME_TOTAL - 1, 1)))
    return leant if is_same else not leant


def check_of(schema_hash: int, lanes: list[int]) -> int:
    """32 bits that hang on all lanes and on what they mean."""
    return zlib.crc32(struct.pack(f"<{len(lanes) + 1}Q", schema_hash, *lanes))

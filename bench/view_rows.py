"""One line of the table of view codecs, and how it is measured."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

ROUNDS = 3
PAPER_BYTES = {  # Table 1
    "height map, 8 bit": 8_600,
    "range map, 8 bit": 8_300,
    "head camera 256x136 q50": 4_900,
    "head camera 512x272 q50": 16_200,
    "chip 200x200 q70": 4_700,
}


@dataclass(frozen=True, slots=True)
class Row:
    """One product by one codec. bytes: mean over the views; ratio: of total bytes, the paper's to these."""

    product: str
    codec: str
    views: int
    bytes: float
    ratio: float
    encode_ms: float
    decode_ms: float
    paper_bytes: int | None = None
    p95_mm: float | None = None  # error to the true surface away from edges, where that is known


@dataclass(frozen=True, slots=True)
class Coded:
    """One view, coded."""

    size_bytes: int
    encode_ms: float
    decode_ms: float


View = TypeVar("View")


def coded(view: View, encode: Callable[[View], bytes], decode: Callable[[bytes], object]) -> Coded:
    """Encode and decode one view ROUNDS times."""
    encode_ms, decode_ms, message = [], [], b""
    for _ in range(ROUNDS):
        start = time.process_time()
        message = encode(view)
        middle = time.process_time()
        decode(message)
        encode_ms.append(1e3 * (middle - start))
        decode_ms.append(1e3 * (time.process_time() - middle))
    return Coded(len(message), min(encode_ms), min(decode_ms))


def row(product: str, codec: str, views: list[Coded], paper: list[Coded]) -> Row:
    """The figures of one product by one codec, against the paper's encoding of the same views."""
    total = sum(view.size_bytes for view in views)
    return Row(
        product,
        codec,
        len(views),
        total / len(views),
        sum(view.size_bytes for view in paper) / total,
        statistics.median(view.encode_ms for view in views),
        statistics.median(view.decode_ms for view in views),
        PAPER_BYTES.get(product),
    )

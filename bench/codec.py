"""How many DCCL messages one core encodes and decodes: `python -m bench.codec`.

From protobuf object to bytes and back. CPU time of this process, best of several rounds, so that other
work on the machine counts little. The C++ figures are those of the wire format's specification: DCCL 4.2.0,
one thread of a shared AMD EPYC.
"""

from __future__ import annotations

import argparse
import json
import random
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from bench.machine import provenance
from messages.dccl import Codec, load_proto

OUT = Path("out/bench/codec.json")
PROTO = Path(__file__).with_name("codec.proto")
ROUNDS = 9
ROUND_S = 0.25
NOW_S = 1_700_000_500
NS_PER_S = 1_000_000_000
SAMPLES = 64  # different messages, so that no branch is always the same
BATCH = 333 * 30  # half a minute of a 333 Hz log

CPP_PER_S = {  # encodes, decodes
    "RobotState": (5_478, 4_928),
    "FlatState": (10_373, 7_513),
    "NavigationReport": (55_354, 30_182),
}


@dataclass(frozen=True, slots=True)
class CodecFigures:
    """One message type and way of coding; per second of one core. factors: against the C++ library."""

    message: str
    way: str
    dccl_bytes: int
    protobuf_bytes: int
    encodes_per_s: int
    decodes_per_s: int
    encode_factor: float
    decode_factor: float


def sample(source: random.Random, name: str) -> dict[str, Any]:
    """Field values of one message, within their bounds."""

    def several(count: int, low: float, high: float) -> list[float]:
        return [source.uniform(low, high) for _ in range(count)]

    if name == "NavigationReport":
        return {
            "x": source.uniform(-10000, 10000),
            "y": source.uniform(-10000, 10000),
            "z": source.uniform(-5000, 0),
            "kind": source.choice((1, 2, 3)),
            "ok": source.choice((True, False)),
        }
    pose = {
        "utime": NOW_S * 1_000_000 + source.randrange(1_000_000_000),
        **dict(zip("xyz", (*several(2, -1000, 1000), *several(1, -100, 100)), strict=True)),
    }
    if name == "FlatState":
        orientation = dict(zip(("qx", "qy", "qz", "qw"), several(4, -1, 1), strict=True))
        return {**pose, **orientation, **{f"j{i}": v for i, v in enumerate(several(28, -4, 4))}}
    return {
        **pose,
        "quat": several(4, -1, 1),
        "joint_position": several(28, -4, 4),
        "joint_effort": several(28, -470, 370),
        "foot": several(6, -500, 2000),
        "hand": several(12, -600, 600),
    }


def rate_per_s(work: Callable[[], object], count: int) -> int:
    """How often per CPU second `work`, which does a thing `count` times, does it: the best round."""
    work()
    best_s = float("inf")
    for _ in range(ROUNDS):
        repeats, started_s = 0, time.process_time()
        while time.process_time() - started_s < ROUND_S:
            work()
            repeats += 1
        best_s = min(best_s, (time.process_time() - started_s) / (repeats * count))
    return round(1 / best_s)


def measure(name: str, codec: Codec[Any]) -> list[CodecFigures]:
    """One message at a time, and whole columns where the layout allows it."""
    source = random.Random(7)
    samples = [sample(source, name) for _ in range(SAMPLES)]
    messages = [codec.message_type(**fields) for fields in samples]
    encoded = [codec.encode(message) for message in messages]
    protobuf_bytes = round(sum(len(m.SerializeToString()) for m in messages) / SAMPLES)

    def encode() -> None:
        for message in messages:
            codec.encode(message)

    def decode() -> None:
        for data in encoded:
            codec.decode(data, NOW_S * NS_PER_S)

    def figures(way: str, encodes_per_s: int, decodes_per_s: int) -> CodecFigures:
        cpp_encodes, cpp_decodes = CPP_PER_S[name]
        return CodecFigures(
            name,
            way,
            len(encoded[0]),
            protobuf_bytes,
            encodes_per_s,
            decodes_per_s,
            round(encodes_per_s / cpp_encodes, 1),
            round(decodes_per_s / cpp_decodes, 1),
        )

    columns = {field: np.array([samples[i % SAMPLES][field] for i in range(BATCH)]) for field in samples[0]}
    rows = codec.encode_many(columns)
    assert rows[0].tobytes() == encoded[0]  # the two ways must not be different codecs
    return [
        figures("messages", rate_per_s(encode, SAMPLES), rate_per_s(decode, SAMPLES)),
        figures(
            "columns",
            rate_per_s(lambda: codec.encode_many(columns), BATCH),
            rate_per_s(lambda: codec.decode_many(rows, NOW_S * NS_PER_S), BATCH),
        ),
    ]


def main() -> None:
    """Print a table, or JSON; either way leave the figures in out/bench/codec.json."""
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    types = load_proto(PROTO)
    figures = [f for name in CPP_PER_S for f in measure(name, Codec(types[f"bench.{name}"]))]
    document = {**provenance(), "cpp_per_s": CPP_PER_S, "codec": [asdict(f) for f in figures]}
    OUT.parent.mkdir(parents=True, exist_ok=True)
    OUT.write_text(json.dumps(document, indent=1))
    if arguments.json:
        print(OUT.read_text())
        return
    table = Table(title="DCCL on one core, and times the C++ library", title_justify="left", box=SIMPLE)
    table.add_column("message", no_wrap=True)
    table.add_column("way", no_wrap=True)
    for heading in ("bytes", "protobuf", "encodes/s", "", "decodes/s", ""):
        table.add_column(heading, justify="right", no_wrap=True)
    for f in figures:
        table.add_row(
            f.message,
            f.way,
            str(f.dccl_bytes),
            str(f.protobuf_bytes),
            f"{f.encodes_per_s:,}",
            f"x{f.encode_factor:.1f}",
            f"{f.decodes_per_s:,}",
            f"x{f.decode_factor:.1f}",
        )
    console = Console()
    console.width = max(console.width, 100)
    console.print(table)


if __name__ == "__main__":
    main()

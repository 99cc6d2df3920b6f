"""Hostile bytes to every view decoder: `python -m bench.view_fuzz --seconds 120`.

Each case is a whole message damaged, or a header that promises much before a body that is noise or stands
for megabytes. A decoder returns a view or raises DecodeError, within 1 s of CPU time and 64 MB; what does
not is kept under out/bench/view_fuzz and makes the exit code 1. Memory is what Python and NumPy allocate
(tracemalloc), and besides, as libraries allocate too, how far the process grew where the kernel tells.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from bench.machine import provenance
from bench.view_hostile import MAKERS, Kind, whole_messages
from perception_server.decode import decode_view
from perception_server.view_codec import (
    DecodeError,
    decode_cloud,
    decode_map,
    decode_octree,
    unpack_jpeg,
    warm_up,
)

OUT = Path("out/bench/view_fuzz.json")
KEPT = Path("out/bench/view_fuzz")
MOST_S, MOST_BYTES = 1.0, 64 << 20
RESIDENT, RESIDENT_PEAK = "VmRSS", "VmHWM"

DECODERS: dict[Kind, Callable[[bytes], object]] = {
    "map": decode_map,
    "cloud": decode_cloud,
    "octree": decode_octree,
    "image": unpack_jpeg,
    "view": decode_view,
}


@dataclass(slots=True)
class Tally:
    """What became of the messages to one decoder. slowest, largest: which maker's cases those were."""

    cases: int = 0
    decoded: int = 0
    refused: int = 0
    worst_ms: float = 0.0
    slowest: str = ""
    worst_traced_mb: float = 0.0
    worst_grown_mb: float = 0.0
    largest: str = ""
    broken: list[str] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Outcome:
    """One call. wrong: what was raised besides DecodeError, "" for nothing."""

    decoded: bool
    cpu_s: float
    traced_bytes: int
    grown_bytes: int
    wrong: str


def call(decode: Callable[[bytes], object], message: bytes) -> Outcome:
    """Decode once, measured."""
    _forget_peak()
    before = _status_bytes(RESIDENT)
    tracemalloc.reset_peak()
    held = tracemalloc.get_traced_memory()[0]
    decoded, wrong, start = False, "", time.process_time()
    try:
        decode(message)
        decoded = True
    except DecodeError:
        pass
    except Exception as error:  # what fuzzing looks for
        wrong = f"{type(error).__name__}: {error}"
    cpu_s = time.process_time() - start
    traced = tracemalloc.get_traced_memory()[1] - held
    return Outcome(decoded, cpu_s, traced, _status_bytes(RESIDENT_PEAK) - before, wrong)


def cases(seed: int) -> Iterator[tuple[Kind, str, bytes]]:
    """Messages without end: decoder, maker, bytes. The same seed gives the same ones."""
    random = np.random.default_rng(seed)
    whole = whole_messages()
    while True:
        for maker in MAKERS:
            for kind in DECODERS:
                message = maker(random, kind, whole[kind])
                if message is not None:
                    yield kind, maker.__name__, message


def fuzz(seconds: float, seed: int) -> dict[Kind, Tally]:
    """Until the time is up."""
    warm_up()
    for kind, messages in whole_messages().items():
        for message in messages:
            DECODERS[kind](message)  # whole ones decode; and what is loaded once is loaded
    tallies = {kind: Tally() for kind in DECODERS}
    tracemalloc.start()
    end_s = time.monotonic() + seconds
    for kind, maker, message in cases(seed):
        if time.monotonic() > end_s:
            break
        _enter(tallies[kind], maker, message, call(DECODERS[kind], message))
    tracemalloc.stop()
    return tallies


def _enter(tally: Tally, maker: str, message: bytes, outcome: Outcome) -> None:
    tally.cases += 1
    tally.decoded += outcome.decoded
    tally.refused += not outcome.decoded and not outcome.wrong
    if 1e3 * outcome.cpu_s > tally.worst_ms:
        tally.worst_ms, tally.slowest = round(1e3 * outcome.cpu_s, 1), maker
    if outcome.traced_bytes / 1e6 > tally.worst_traced_mb:
        tally.worst_traced_mb, tally.largest = round(outcome.traced_bytes / 1e6, 1), maker
    tally.worst_grown_mb = max(tally.worst_grown_mb, round(outcome.grown_bytes / 1e6, 1))
    wrong = [outcome.wrong] if outcome.wrong else []
    wrong += [f"{outcome.cpu_s:.2f} s"] if outcome.cpu_s > MOST_S else []
    largest = max(outcome.traced_bytes, outcome.grown_bytes)
    wrong += [f"{largest} bytes of memory"] if largest > MOST_BYTES else []
    if wrong:
        KEPT.mkdir(parents=True, exist_ok=True)
        path = KEPT / f"{maker}-{len(tally.broken)}-{message[:1].hex()}.bin"
        path.write_bytes(message)
        tally.broken.append(f"{path}: {', '.join(wrong)}")


def _status_bytes(name: str) -> int:
    """A figure of this process in bytes; 0 where the kernel does not tell."""
    try:
        status = Path("/proc/self/status").read_text()
    except OSError:
        return 0
    return int(status.partition(f"{name}:")[2].split()[0]) * 1024


def _forget_peak() -> None:
    """Let the kernel count the largest size anew (proc(5), clear_refs)."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return


def main() -> int:
    parser = argparse.ArgumentParser(description="Hostile bytes to every view decoder.")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    tallies = fuzz(arguments.seconds, arguments.seed)
    document = {
        **provenance(),
        "seed": arguments.seed,
        "decoders": {kind: asdict(tally) for kind, tally in tallies.items()},
    }
    OUT.parent.mkdir(parents=True, exist_ok=True)
    OUT.write_text(json.dumps(document, indent=2) + "\n")
    if arguments.json:
        print(json.dumps(document, indent=2))
    else:
        print(
            f"{'decoder':9}{'cases':>8}{'decoded':>9}{'refused':>9}{'worst ms':>10}{'MB':>7}{'grown MB':>10}"
        )
        for kind, t in tallies.items():
            counts = f"{t.cases:8}{t.decoded:9}{t.refused:9}"
            print(f"{kind:9}{counts}{t.worst_ms:10}{t.worst_traced_mb:7}{t.worst_grown_mb:10}", end="  ")
            print(f"{t.slowest}, {t.largest}")
    broken = [line for tally in tallies.values() for line in tally.broken]
    print(*broken, sep="\n", file=sys.stderr)
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())

"""kill -9 of each shaper at random moments: what becomes of reliable messages, and how soon traffic is back.

    python -m bench.wire_kill [--kills 20] [--seed 1] [--json]

Commands of 10 Hz each way; every one must be on the other bus once, or its publisher be told that it is
not. Exit code 1 if a message is lost without a word, doubled, or a journal is corrupt. Until a message has
crossed each way after a kill, three things take their time:

    process    until the new process has its port and its bus: interpreter, imports, Zenoh
    handshake  from then on, until it has proof that the peer is there: one round trip, less what it has
               had of it while the process was loading
    channel    from then on too, until a message has crossed, without the wait for one to be published:
               the slower direction
    resume     the same with that wait

channel - 2 rtt is what the channel takes beyond two round trips as measured just before the kill, less
the 10 ms of a full datagram at 1 Mbit/s: what had gathered for the dead comes in one. It is how late
processes run.
"""

from __future__ import annotations

import argparse
import json
import random
import sqlite3
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import zenoh

from bench.machine import keep
from bench.wire_rig import COMMAND_KEYS, DELAY_MS, WireRig, wait_until
from messages.attachment import Stamp
from shaper.bus import open_bus

_PERIOD_S = 0.1
_FULL_DATAGRAM_S = 0.01
_SIDES = ("robot", "operator")
_FINAL = frozenset({"delivered", "expired", "lost", "shed", "refused", "unreadable"})


class Publishers:
    """Commands both ways, what arrived of them, and what their publishers were told."""

    def __init__(self, rig: WireRig) -> None:
        self._sessions = {side: open_bus(rig.bus(side)) for side in _SIDES}
        self.sent: dict[str, int] = dict.fromkeys(_SIDES, 0)
        self.arrived: dict[str, Counter[int]] = {side: Counter() for side in _SIDES}
        self.told: dict[str, dict[int, list[str]]] = {side: {} for side in _SIDES}
        self.crossed: dict[str, list[tuple[int, int]]] = {side: [] for side in _SIDES}  # (put, came)
        self._put_ns: dict[str, list[int]] = {side: [0] for side in _SIDES}  # by number
        self._stop = threading.Event()
        self._kept: list[Any] = []
        for side, other in (("robot", "operator"), ("operator", "robot")):
            session, key = self._sessions[side], COMMAND_KEYS[side]
            self._kept.append(
                session.declare_subscriber(f"@straitlink/receipt/{key}", self._on_receipt(side))
            )
            self._kept.append(self._sessions[other].declare_subscriber(key, self._on_command(side)))
        self._threads = [threading.Thread(target=self._publish, args=(side,)) for side in _SIDES]
        for thread in self._threads:
            thread.start()

    def _on_receipt(self, side: str) -> Any:
        def on_sample(sample: zenoh.Sample) -> None:
            receipt = json.loads(sample.payload.to_bytes())
            self.told[side].setdefault(receipt["sequence"], []).append(receipt["stage"])

        return on_sample

    def _on_command(self, side: str) -> Any:
        def on_sample(sample: zenoh.Sample) -> None:
            number = int.from_bytes(sample.payload.to_bytes()[:4], "little")
            self.arrived[side][number] += 1
            self.crossed[side].append((self._put_ns[side][number], time.monotonic_ns()))

        return on_sample

    def _publish(self, side: str) -> None:
        publisher = self._sessions[side].declare_publisher(COMMAND_KEYS[side])
        while not self._stop.wait(_PERIOD_S):
            number = self.sent[side] = self.sent[side] + 1
            self._put_ns[side].append(time.monotonic_ns())
            stamp = Stamp(time.time_ns(), number).encode()
            publisher.put(number.to_bytes(4, "little") + bytes(40), attachment=stamp)

    def stop(self) -> None:
        """Publish no more."""
        self._stop.set()
        for thread in self._threads:
            thread.join()

    def close(self) -> None:
        """Leave the buses."""
        self.stop()
        for session in self._sessions.values():
            session.close()


@contextmanager
def _publishing(rig: WireRig) -> Iterator[Publishers]:
    publishers = Publishers(rig)
    try:
        yield publishers
    finally:
        publishers.close()


def measure(kills: int, seed: int) -> dict[str, Any]:
    """Kill each side so many times, in turn, at random moments."""
    rng = random.Random(seed)
    resumes: list[Resume] = []
    with tempfile.TemporaryDirectory() as folder, WireRig(Path(folder)) as rig:
        rig.start_all()
        with _publishing(rig) as publishers:
            time.sleep(3)
            for index in range(2 * kills):
                side = _SIDES[index % 2]
                time.sleep(rng.uniform(0.2, 2.0))
                rig.kill(side)
                spawned_ns = time.monotonic_ns()
                rig.start(side)
                time.sleep(1.0)
                resumes.append(_resume(rig, publishers, side, spawned_ns))
            publishers.stop()
            time.sleep(14)  # a command lives for ten seconds
            result = _account(publishers)
        corrupt = sum(_is_corrupt(Path(folder) / f"{side}.journal") for side in _SIDES if _ended(rig, side))
    return {
        "kills": 2 * kills,
        **result,
        "corrupt_journals": corrupt,
        "each": [asdict(resume) for resume in resumes],
        "rtt p50, max": _spread(r.rtt_s for r in resumes),
        "process p50, max": _spread(r.process_s for r in resumes),
        "handshake p50, max": _spread(r.handshake_s for r in resumes),
        "channel p50, max": _spread(r.channel_s for r in resumes),
        "resume p50, max": _spread(r.resume_s for r in resumes),
        "channel - 2 rtt p50, max": _spread(r.channel_s - 2 * r.rtt_s - _FULL_DATAGRAM_S for r in resumes),
    }


def _spread(values_s: Iterable[float]) -> tuple[float, float]:
    """Median and maximum, in seconds."""
    ordered = sorted(values_s)
    return round(ordered[len(ordered) // 2], 3), round(ordered[-1], 3)


@dataclass(frozen=True, slots=True)
class Resume:
    """What followed a kill. rtt_s: as the other side knew it before."""

    rtt_s: float
    process_s: float
    handshake_s: float
    channel_s: float
    resume_s: float


def _resume(rig: WireRig, publishers: Publishers, side: str, spawned_ns: int) -> Resume:
    """From the new process's trace and the two buses, which share a clock; a bus adds a millisecond."""
    records = rig.records(side)
    started_ns = next(r["t_ns"] for r in reversed(records) if r["event"] == "start")
    secured = [r["t_ns"] for r in records if r.get("kind") == "secured" and r["t_ns"] >= started_ns]
    firsts = []
    for name in _SIDES:
        wait_until(lambda name=name: publishers.crossed[name][-1][1] > started_ns)  # type: ignore[misc]
        firsts.append(next(times for times in publishers.crossed[name] if times[1] > started_ns))
    other = rig.records("operator" if side == "robot" else "robot")
    rtts_ns = [r["rtt_ns"] for r in other if r["event"] == "link_state" and r["t_ns"] < started_ns]
    return Resume(
        next((rtt_ns for rtt_ns in reversed(rtts_ns) if rtt_ns), 2_000_000 * DELAY_MS) / 1e9,
        (started_ns - spawned_ns) / 1e9,
        (min(secured, default=started_ns) - started_ns) / 1e9,
        max((came_ns - max(started_ns, put_ns)) / 1e9 for put_ns, came_ns in firsts),
        max((came_ns - started_ns) / 1e9 for _, came_ns in firsts),
    )


def _account(publishers: Publishers) -> dict[str, int]:
    counts: Counter[str] = Counter()
    for side in _SIDES:
        arrived, told = publishers.arrived[side], publishers.told[side]
        for number in range(1, publishers.sent[side] + 1):
            copies, stages = arrived[number], told.get(number, [])
            counts["published"] += 1
            counts["doubled"] += copies > 1
            counts["arrived"] += copies > 0
            if copies:
                continue
            if not stages:
                counts["never_accepted"] += 1  # no shaper was there: its publisher was told nothing
            elif set(stages) & _FINAL - {"delivered"}:
                counts["reported"] += 1
            else:
                counts["lost_without_a_word"] += 1
    names = ("published", "arrived", "reported", "never_accepted", "doubled", "lost_without_a_word")
    return {name: counts[name] for name in names}


def _ended(rig: WireRig, side: str) -> bool:
    rig.kill(side)
    return True


def _is_corrupt(path: Path) -> bool:
    db = sqlite3.connect(path)
    try:
        return bool(db.execute("PRAGMA integrity_check").fetchone()[0] != "ok")
    finally:
        db.close()


def main() -> None:
    """Measure and print; exit code 1 if anything is lost or doubled."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    result = measure(arguments.kills, arguments.seed)
    document = keep("wire_kill", result)
    if arguments.json:
        print(json.dumps(document, indent=1))
    else:
        del result["each"]
        for name, value in result.items():
            print(f"{name:24} {value}")
    sys.exit(bool(result["doubled"] or result["lost_without_a_word"] or result["corrupt_journals"]))


if __name__ == "__main__":
    main()

"""A day of the Trials' link in virtual time: does anything grow, wrap or come unbalanced?

`python -m bench.soak`, a light load so that 24 hours take minutes. Watched once an hour: memory (the
process's, and Python's live objects), the ledger's balance, counters below zero, offers that the ledger
does not know; and every reliable message, once each and in order. On the way the 32-bit microsecond stamps
wrap twenty times, packet numbers more often.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

from bench.machine import provenance
from bench.pair import Pair
from netem_scripts.event_loop import EventLoop
from netem_scripts.profiles import load_profile
from shaper.events import Delivered
from shaper.traffic_class import DEFAULT_CLASSES, TopicRule

OUT = Path("out/bench/soak.json")
_NS_PER_S = 1_000_000_000
_PAGE_BYTES = os.sysconf("SC_PAGE_SIZE")
_SETTLED_HOURS = 2  # memory is compared from here on; caches have filled by then
_ALLOWED_GROWTH_MB = 3.0
# key, class, bytes, period in ms
SOURCES = (
    ("robot/heartbeat", "heartbeat", 64, 500),
    ("robot/joints", "state", 160, 500),
    ("robot/image", "perception", 6000, 10_000),
    ("robot/plan_result", "plan", 300, 20_000),
)


@dataclass(frozen=True, slots=True)
class Hour:
    """At the end of an hour. Counts are since the start."""

    hour: int
    memory_mb: float
    objects: int
    offered: int
    delivered: int
    datagrams: int


@dataclass(slots=True)
class Soak:
    """The whole day. faults: what went wrong, in sentences; empty is what we want."""

    hours: list[Hour] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    cpu_s: float = 0.0
    growth_mb: float = 0.0


class _Watch:
    """What the operator was given of the reliable topic."""

    def __init__(self, soak: Soak) -> None:
        self._soak = soak
        self._last = -1
        self.delivered = 0

    def on_delivered(self, event: Delivered) -> None:
        self.delivered += 1
        if event.key != "robot/plan_result":
            return
        number = int.from_bytes(event.payload[:4], "little")
        if number != self._last + 1:
            self._soak.faults.append(f"plan {number} was delivered after plan {self._last}")
        self._last = number


def run(hours: int, seed: int) -> Soak:
    """Play it and look once an hour."""
    soak = Soak()
    loop = EventLoop()
    watch = _Watch(soak)
    rules = [TopicRule(key, DEFAULT_CLASSES[name]) for key, name, _, _ in SOURCES]
    pair = Pair(loop, load_profile("trials"), rules, 4096, seed, watch.on_delivered)
    for key, _, size, period_ms in SOURCES:
        _publish(loop, pair, key, size, period_ms * 1_000_000)
    started_s = time.process_time()
    for hour in range(1, hours + 1):
        loop.run_until(hour * 3600 * _NS_PER_S)
        soak.hours.append(_look(pair, watch, hour, soak))
    soak.cpu_s = round(time.process_time() - started_s, 1)
    settled = soak.hours[min(_SETTLED_HOURS, len(soak.hours)) - 1 :]
    soak.growth_mb = round(settled[-1].memory_mb - settled[0].memory_mb, 2)
    if soak.growth_mb > _ALLOWED_GROWTH_MB:
        soak.faults.append(f"memory grew by {soak.growth_mb} MB, more than {_ALLOWED_GROWTH_MB}")
    return soak


def _publish(loop: EventLoop, pair: Pair, key: str, size: int, period_ns: int) -> None:
    count = 0

    def publish() -> None:
        nonlocal count
        loop.call_at(loop.now_ns + period_ns, publish)
        pair.offer(key, count.to_bytes(4, "little") + bytes(size - 4))
        count += 1

    loop.call_at(_NS_PER_S, publish)


def _look(pair: Pair, watch: _Watch, hour: int, soak: Soak) -> Hour:
    for key, ledger in pair.robot.sent_ledgers().items():
        if min(ledger.counters()) < 0:
            soak.faults.append(f"hour {hour}: a counter of {key} is below zero: {ledger.as_dict()}")
        if ledger.queued < 0:
            soak.faults.append(f"hour {hour}: the ledger of {key} does not balance: {ledger.as_dict()}")
    offered = sum(ledger.offered for ledger in pair.robot.sent_ledgers().values())
    if offered != pair.offered:
        soak.faults.append(f"hour {hour}: {pair.offered} messages were offered, the ledger knows {offered}")
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return Hour(
        hour,
        round(pages * _PAGE_BYTES / 1e6, 2),
        len(gc.get_objects()),
        offered,
        watch.delivered,
        pair.robot.counters.sent_datagrams,
    )


def main() -> int:
    """Print the hours and leave them in out/bench/soak.json; exit code 1 if anything went wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hours", type=int, default=24)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    a = parser.parse_args()
    soak = run(a.hours, a.seed)
    document = {**provenance(), **asdict(soak)}
    OUT.parent.mkdir(parents=True, exist_ok=True)
    OUT.write_text(json.dumps(document, indent=1))
    if a.json:
        print(json.dumps(document, indent=1))
    else:
        for h in soak.hours:
            print(
                f"hour {h.hour:3}: {h.memory_mb:7.2f} MB, {h.objects:7} objects, {h.offered:9} offered, "
                f"{h.delivered:9} delivered, {h.datagrams:9} datagrams"
            )
        print(f"{soak.cpu_s} s of CPU, memory grew by {soak.growth_mb} MB; {len(soak.faults)} faults")
    for fault in soak.faults[:20]:
        print(fault, file=sys.stderr)
    return 1 if soak.faults else 0


if __name__ == "__main__":
    sys.exit(main())

"""What a shaper costs as topics, messages, links and what lies behind it grow: `python -m bench.scale`.

Virtual time, so that the link is the same however fast the machine is. CPU is that of both ends together,
memory the peak of the process; each point runs in a process of its own. The exponent is the slope of log
cost over log size by least squares: 1 is linear.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import resource
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from bench.machine import provenance
from bench.pair import Pair
from netem_scripts.event_loop import EventLoop
from netem_scripts.profiles import load_profile
from shaper.traffic_class import DEFAULT_CLASSES, TopicRule

OUT = Path("out/bench/scale.json")
PROFILE = "constant-1m-50ms"
PAYLOAD_BYTES = 100
_NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Case:
    """topics share messages_per_s evenly, on each of so many links, for so many seconds.

    backlog: messages that the queue of each topic may hold, reliable ones; 0 keeps the newest only.
    """

    topics: int
    messages_per_s: int
    links: int
    seconds: int
    backlog: int = 0

    @property
    def rule(self) -> TopicRule:
        """Of all its topics."""
        state, plan = DEFAULT_CLASSES["state"], DEFAULT_CLASSES["plan"]
        return TopicRule("robot/**", replace(plan, depth=self.backlog) if self.backlog else state)


@dataclass(frozen=True, slots=True)
class Point:
    """One case, run. cpu_us_per_message: of both ends, whatever became of the message."""

    case: Case
    cpu_of_a_core: float
    cpu_us_per_message: float
    memory_mb: float
    delivered_per_s: float


@dataclass(frozen=True, slots=True)
class Curve:
    """How a cost grows with one quantity. exponent: 1 is linear, 0 is what time should cost."""

    quantity: str
    points: list[Point]
    cpu_exponent: float
    memory_exponent: float


CURVES: dict[str, list[Case]] = {
    "topics": [Case(n, 1000, 1, 20) for n in (10, 100, 1000, 10_000)],
    "messages_per_s": [Case(20, n, 1, 20) for n in (100, 1000, 5000, 20_000)],
    "links": [Case(5, 100, n, 10) for n in (1, 5, 20, 50)],
    "seconds": [Case(20, 1000, 1, n) for n in (10, 40, 160, 320)],
    "backlog": [Case(1, 1000, 1, 60, n) for n in (10, 100, 1000, 10_000)],
}


def measure(case: Case) -> Point:
    """Play it in this process."""
    loop = EventLoop()
    profile = load_profile(PROFILE)
    max_topics = max(4096, case.topics)
    pairs = [Pair(loop, profile, [case.rule], max_topics, seed) for seed in range(case.links)]
    payload = os.urandom(PAYLOAD_BYTES)
    end_ns = case.seconds * _NS_PER_S
    for pair in pairs:
        for topic in range(case.topics):
            _publish(loop, pair, f"robot/topic/{topic}", payload, topic, case, end_ns)
    started_s = time.process_time()
    loop.run_until(end_ns)
    cpu_s = time.process_time() - started_s
    messages = case.messages_per_s * case.seconds * case.links
    return Point(
        case,
        round(cpu_s / case.seconds, 4),
        round(cpu_s / messages * 1e6, 2),
        round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3, 1),
        round(sum(pair.delivered for pair in pairs) / case.seconds, 1),
    )


def _publish(
    loop: EventLoop, pair: Pair, key: str, payload: bytes, number: int, case: Case, end_ns: int
) -> None:
    period_ns = case.topics * _NS_PER_S // case.messages_per_s

    def publish() -> None:
        if loop.now_ns + period_ns < end_ns:
            loop.call_at(loop.now_ns + period_ns, publish)
        pair.offer(key, payload)

    loop.call_at(number * period_ns // case.topics, publish)


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """The slope of log cost over log size by least squares."""
    xs, ys = [math.log(s) for s in sizes], [math.log(max(c, 1e-9)) for c in costs]
    x_mean, y_mean = sum(xs) / len(xs), sum(ys) / len(ys)
    covariance = sum((x - x_mean) * (y - y_mean) for x, y in zip(xs, ys, strict=True))
    return round(covariance / sum((x - x_mean) ** 2 for x in xs), 3)


def _in_own_process(case: Case) -> Point:
    command = [sys.executable, "-m", "bench.scale", "--case", json.dumps(asdict(case))]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=600)
    values = json.loads(done.stdout)
    return Point(**{**values, "case": case})


def curve(quantity: str, cases: Sequence[Case]) -> Curve:
    """All points of one curve."""
    points = [_in_own_process(case) for case in cases]
    sizes = [getattr(case, quantity) for case in cases]
    return Curve(
        quantity,
        points,
        exponent(sizes, [p.cpu_of_a_core for p in points]),
        exponent(sizes, [p.memory_mb for p in points]),
    )


def main() -> None:
    """Print the curves and leave them in out/bench/scale.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--case", type=json.loads, help=argparse.SUPPRESS)
    parser.add_argument("--json", action="store_true")
    a = parser.parse_args()
    if a.case is not None:
        print(json.dumps(asdict(measure(Case(**a.case)))))
        return
    curves = [curve(quantity, cases) for quantity, cases in CURVES.items()]
    document = {**provenance(), "curves": [asdict(c) for c in curves]}
    OUT.parent.mkdir(parents=True, exist_ok=True)
    OUT.write_text(json.dumps(document, indent=1))
    if a.json:
        print(json.dumps(document, indent=1))
        return
    for c in curves:
        print(f"{c.quantity}: CPU grows with exponent {c.cpu_exponent}, memory with {c.memory_exponent}")
        for p in c.points:
            size = getattr(p.case, c.quantity)
            print(
                f"  {size:7}: {p.cpu_of_a_core:8.4f} of a core, {p.cpu_us_per_message:7.2f} us per message, "
                f"{p.memory_mb:7.1f} MB, {p.delivered_per_s:8.1f} delivered/s"
            )


if __name__ == "__main__":
    main()

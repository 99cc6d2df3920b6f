"""What we changed since the Trials, measured: `python -m bench.trials_rule`.

The same missions with the link rule and the queues that team MIT's shaper had in December 2013, with ours,
and with one of each. Virtual time: all figures are exact, the same on any machine. Their rule needs clocks
that agree, so it gets them; ours does without.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
from dataclasses import asdict, dataclass, replace

from bench.link_controls import TrialsRule
from bench.machine import keep
from netem_scripts.profiles import load_profile
from shaper.traffic_class import Keep, TrafficClass
from straitlink.mission import Load, MissionSettings, load_named_or_file, run_mission

PROFILES = ("trials", "trials-swapped", "lossy-10", "blackouts")
LOAD = "camera-flood"
MINUTES = 4.0
SEEDS = (1, 2, 3)
WAYS = {  # name: (their link rule, their queues)
    "the Trials' shaper": (True, True),
    "their link rule, our queues": (True, False),
    "our estimator, their queues": (False, True),
    "straitlink": (False, False),
}
_FOR_EVER_NS = 3600 * 1_000_000_000


def _channel(name: str, tier: int, depth: int) -> TrafficClass:
    """A ring buffer per channel, strict priority, no time to live, nothing repeated.

    Parity for what takes several datagrams: theirs were 21 for every 20, ours round down, so that it takes
    1/16 to have one for a picture. Theirs is always sent, ours only while something is lost.
    """
    return TrafficClass(
        name, tier, Keep.ALL, _FOR_EVER_NS, depth, max_parity_ratio=1 / 16, target_ratio=0.9999
    )


CHANNELS = {  # group of drc_robot_02_trials.cfg: priority, buffer
    "robot/heartbeat": _channel("as EST_ROBOT_STATE", 1, 1),
    "robot/joints": _channel("EST_ROBOT_STATE", 1, 1),
    "operator/command": _channel("commands", 2, 10),
    "robot/image": _channel("CAMERA", 3, 1),
}


@dataclass(frozen=True, slots=True)
class Flight:
    """One mission. Counts are delivered and offered; ages in ms at delivery."""

    profile: str
    way: str
    seed: int
    heartbeats: tuple[int, int]
    heartbeat_p50_ms: float
    heartbeat_p95_ms: float
    heartbeat_max_ms: float
    joints: tuple[int, int]
    images: tuple[int, int]
    image_p50_ms: float
    commands: tuple[int, int]
    command_p95_ms: float
    utilisation: float
    queue_p95_ms: float
    queue_max_ms: float
    trace_sha256: str


def fly(profile: str, way: str, seed: int, minutes: float = MINUTES) -> Flight:
    """One mission."""
    rule, queues = WAYS[way]
    settings = MissionSettings(
        load_profile(profile), _load(queues), round(minutes * 60e9), seed, synchronised=rule
    )
    result = run_mission(replace(settings, estimator=TrialsRule) if rule else settings)
    topics, down = result["topics"], result["link"]["down"]
    counts = {key: (row["delivered"], row["offered"]) for key, row in topics.items()}
    heartbeat = topics["robot/heartbeat"]
    return Flight(
        profile,
        way,
        seed,
        heartbeats=counts["robot/heartbeat"],
        heartbeat_p50_ms=heartbeat["age_p50_ms"],
        heartbeat_p95_ms=heartbeat["age_p95_ms"],
        heartbeat_max_ms=heartbeat["age_max_ms"],
        joints=counts["robot/joints"],
        images=counts["robot/image"],
        image_p50_ms=topics["robot/image"]["age_p50_ms"],
        commands=counts["operator/command"],
        command_p95_ms=topics["operator/command"]["age_p95_ms"],
        utilisation=down["utilisation"],
        queue_p95_ms=down["queue_delay_p95_ms"],
        queue_max_ms=down["queue_delay_max_ms"],
        trace_sha256=result["trace_sha256"],
    )


def _load(their_queues: bool) -> Load:
    load = load_named_or_file(LOAD)
    if not their_queues:
        return load
    return replace(load, topics=tuple(replace(t, traffic_class=CHANNELS[t.key]) for t in load.topics))


def _fly(job: tuple[str, str, int, float]) -> Flight:
    return fly(*job)


def main() -> None:
    """Print the flights and leave them in out/bench/trials_rule.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--profiles", nargs="*", default=PROFILES)
    parser.add_argument("--seeds", nargs="*", type=int, default=SEEDS)
    parser.add_argument("--minutes", type=float, default=MINUTES)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--json", action="store_true")
    a = parser.parse_args()
    jobs = [(profile, way, seed, a.minutes) for profile in a.profiles for way in WAYS for seed in a.seeds]
    with multiprocessing.Pool(a.processes) as pool:
        flights = pool.map(_fly, jobs, chunksize=1)
    document = keep("trials_rule", {"minutes": a.minutes, "flights": [asdict(f) for f in flights]})
    if a.json:
        print(json.dumps(document, indent=1))
        return
    for f in flights:
        print(
            f"{f.profile:15} {f.way:28} seed {f.seed}: heartbeats {f.heartbeats[0]}/{f.heartbeats[1]}, age "
            f"p50/p95/max {f.heartbeat_p50_ms:.0f}/{f.heartbeat_p95_ms:.0f}/{f.heartbeat_max_ms:.0f} ms, "
            f"images {f.images[0]}/{f.images[1]}, commands {f.commands[0]}/{f.commands[1]} p95 "
            f"{f.command_p95_ms:.0f} ms, link {f.utilisation:.1%}, queue max {f.queue_max_ms:.0f} ms"
        )


if __name__ == "__main__":
    main()

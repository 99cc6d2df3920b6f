"""Whether the estimator ever locks up: `python -m bench.link_liveness [--profiles 200] [--seed 100]`.

Random links, always backlogged; every 10 s in which a direction has been stable for 5 round trips and 2 s
must be used by half at least. Apart are counted the windows in which reports had to wait: where one direction
falls, its buffer holds seconds of what was sent before anyone knew; the news of the other direction stands in
that queue, and nobody can have it sooner.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from bench.link_estimation import Departures, estimators
from bench.link_rows import ROWS
from bench.link_score import GRID_NS, NS_PER_S, WINDOW_NS, Score, judge, stable_windows
from bench.machine import provenance
from straitlink.mission import MissionSettings, load_named_or_file, run_mission

OUT = Path("out/bench/link_liveness.json")
LEAST_USE = 0.5
NEWS_WAITS_NS = 300_000_000  # of queue on the way back; what we keep there ourselves is a sixth of it


@dataclass(frozen=True, slots=True)
class Window:
    """Ten seconds, used too little. waited_s: the longest queue on the way back, then or just before."""

    row: str
    seed: int
    way: str
    at_s: float
    use: float
    waited_s: float


def fly(seed: int, minutes: float) -> tuple[int, list[Window]]:
    """One link: how many windows there were, and those used too little. Odd seeds are alike both ways."""
    row = "random-alike" if seed % 2 else "random"
    profile, duration_ns, departures = ROWS[row].make(seed), round(minutes * 60e9), Departures()
    load, estimator = load_named_or_file("backlogged"), estimators()["adaptive"]
    run_mission(MissionSettings(profile, load, duration_ns, seed, estimator=estimator), departures)
    ways = {"down": (profile.down, profile.up), "up": (profile.up, profile.down)}
    scores = {way: judge(*ways[way], departures.packets[way], duration_ns) for way in ways}
    count, low = 0, []
    for way, back in (("down", "up"), ("up", "down")):
        windows = stable_windows(ways[way][0], departures.packets[way], duration_ns)
        count += len(windows)
        for use, at_ns in windows:
            if use < LEAST_USE:
                waited_s = _longest_queue_s(scores[back], at_ns - NS_PER_S, at_ns + WINDOW_NS)
                low.append(Window(row, seed, way, at_ns / NS_PER_S, round(use, 3), round(waited_s, 3)))
    return count, low


def _longest_queue_s(score: Score, begin_ns: int, end_ns: int) -> float:
    """score.queue_ns is of the up-time, which on these links is all of it."""
    return float(score.queue_ns[max(0, begin_ns) // GRID_NS : end_ns // GRID_NS].max()) / NS_PER_S


def main() -> int:
    """Exit code 1 if a window was used too little though its news did not have to wait."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--profiles", type=int, default=200)
    parser.add_argument("--seed", type=int, default=100, help="of the first profile")
    parser.add_argument("--minutes", type=float, default=1.5, help="of each")
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    seeds = range(arguments.seed, arguments.seed + arguments.profiles)
    with multiprocessing.Pool(arguments.processes) as pool:
        flown = pool.map(partial(fly, minutes=arguments.minutes), seeds, chunksize=1)
    low = [window for _, windows in flown for window in windows]
    locked = [window for window in low if window.waited_s < NEWS_WAITS_NS / NS_PER_S]
    document = {
        **provenance(),
        "profiles": arguments.profiles,
        "windows": sum(count for count, _ in flown),
        "low": [asdict(window) for window in low],
        "low_though_news_did_not_wait": len(locked),
    }
    OUT.parent.mkdir(parents=True, exist_ok=True)
    OUT.write_text(json.dumps(document, indent=1))
    if arguments.json:
        print(OUT.read_text())
    else:
        for window in low:
            print(
                f"{window.row:12} {window.seed:4} {window.way:4} at {window.at_s:5.1f} s: "
                f"{window.use:4.0%} used, news waited {window.waited_s:4.1f} s"
            )
        print(
            f"{document['windows']} windows of {arguments.profiles} links: {len(low)} below {LEAST_USE:.0%}, "
            f"{len(locked)} of them though no news had to wait"
        )
    return 1 if locked else 0


if __name__ == "__main__":
    raise SystemExit(main())

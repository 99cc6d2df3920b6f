"""How well the estimator uses links that it knows nothing of: `python -m bench.link_estimation`.

Every row is an always-backlogged mission in virtual time; a judge of its own (bench.link_score) replays
what entered the link. Beside our estimator run the present presets, the rule of the Trials and a textbook
delay gradient; --ablation switches each idea off in turn. A single run:
`python -m bench.link_estimation --rows trials --seeds 1 --estimators adaptive`.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import time
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import asdict, dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from bench.link_controls import DelayGradient, TrialsRule
from bench.link_informed import informed, measuring
from bench.link_rows import ROWS, Row
from bench.link_score import Score, judge
from bench.machine import provenance
from netem_scripts.band import Profile
from shaper.estimation.adaptive import AdaptiveEstimator
from shaper.estimation.ideas import Ideas
from shaper.estimation.predicting import PredictingEstimator
from shaper.link_estimator import EstimatorFactory, PresetBands
from shaper.trace_records import Record
from straitlink.mission import MissionSettings, load_named_or_file, run_mission

OUT = Path("out/bench/link_estimation.json")
MINUTES = 6.0
BOUNDS = {"informed": False, "oracle": True}  # told of each change when word of it could have come
TOLD = {"measuring", *BOUNDS}  # that something has changed; they know of no blackouts
SYNCHRONISED = {"trials rule", *TOLD}  # for which both hosts' clocks must show true time


@dataclass(frozen=True, slots=True)
class Figures:
    """One run, both directions together. Reactions: the median over the changes, worst of the directions."""

    row: str
    estimator: str
    seed: int
    utilisation: float
    down_utilisation: float
    up_utilisation: float
    p50_ms: float
    p95_ms: float
    p99_ms: float
    max_ms: float
    long_ratio: float
    tail_drops: int
    down_s: float
    up_s: float
    back_s: float
    peak_over_bound: float
    foreseen_peak_ms: float
    worst_window: float
    payload_ratio: float
    cpu_s: float


class Departures:
    """Takes what enters the link from a mission's trace."""

    def __init__(self) -> None:
        self.packets: dict[str, list[tuple[int, int]]] = {"down": [], "up": []}

    def __call__(self, name: str, record: Record) -> None:
        if name == "link" and record["event"] == "packet":
            t_ns, wire_bytes = record["t_ns"], record["wire_bytes"]
            assert isinstance(t_ns, int) and isinstance(wire_bytes, int)
            self.packets[str(record["direction"])].append((t_ns, wire_bytes))


def estimators() -> dict[str, EstimatorFactory]:
    """By name; the ablations of ours are called adaptive-<idea>."""
    return {
        "adaptive": lambda bands, now_ns: AdaptiveEstimator(now_ns=now_ns),
        **{f"adaptive-{idea.name}": _without(idea.name) for idea in fields(Ideas)},
        "predicting": lambda bands, now_ns: PredictingEstimator(AdaptiveEstimator(now_ns=now_ns)),
        "presets": lambda bands, now_ns: PresetBands(bands, now_ns=now_ns),
        "trials rule": TrialsRule,
        "gradient": DelayGradient,
    }


def _factory(name: str, profile: Profile, duration_ns: int) -> EstimatorFactory:
    if name in BOUNDS:
        return informed(profile, duration_ns, guesses=BOUNDS[name])
    if name == "measuring":
        return measuring(profile, duration_ns)
    return estimators()[name]


def _without(idea: str) -> EstimatorFactory:
    ideas = replace(Ideas(), **{idea: False})
    return lambda bands, now_ns: AdaptiveEstimator(now_ns=now_ns, ideas=ideas)


def fly(row_name: str, estimator: str, seed: int, minutes: float = MINUTES) -> Figures:
    """One mission, judged."""
    row = ROWS[row_name]
    profile, duration_ns = row.make(seed), round(minutes * 60e9)
    departures = Departures()
    settings = MissionSettings(
        profile,
        load_named_or_file("backlogged"),
        duration_ns,
        seed,
        estimator=_factory(estimator, profile, duration_ns),
        max_drift_ppm=row.drift_ppm,
        synchronised=estimator in SYNCHRONISED,
    )
    started_s = time.process_time()
    result = run_mission(settings, departures)
    cpu_s = time.process_time() - started_s
    down = judge(profile.down, profile.up, departures.packets["down"], duration_ns)
    up = judge(profile.up, profile.down, departures.packets["up"], duration_ns)
    wire = sum(size for way in departures.packets.values() for _, size in way)
    payload = sum(row["sent_bytes"] + row["repeated_bytes"] for row in result["topics"].values())
    return _figures(row_name, estimator, seed, (down, up), payload / max(1, wire), cpu_s)


def _figures(
    row: str, estimator: str, seed: int, scores: tuple[Score, Score], payload_ratio: float, cpu_s: float
) -> Figures:
    queue_ms = np.concatenate([score.queue_ns for score in scores]) / 1e6
    changes = [change for score in scores for change in score.changes]
    falls = [c for c in changes if c.new_bps < c.old_bps]
    peaks = [c.peak_s / (c.bound_s + 0.1) for c in falls if c.bound_s > 0.2]
    return Figures(
        row=row,
        estimator=estimator,
        seed=seed,
        utilisation=sum(s.served_bits for s in scores) / sum(s.capacity_bits for s in scores),
        down_utilisation=scores[0].utilisation,
        up_utilisation=scores[1].utilisation,
        p50_ms=float(np.percentile(queue_ms, 50)),
        p95_ms=float(np.percentile(queue_ms, 95)),
        p99_ms=float(np.percentile(queue_ms, 99)),
        max_ms=float(queue_ms.max()),
        long_ratio=float(np.mean(queue_ms > 100)),
        tail_drops=sum(s.tail_drops for s in scores),
        down_s=_middle(c.reaction_s for c in falls),
        up_s=_middle(c.reaction_s for c in changes if c.new_bps > c.old_bps),
        back_s=max((r.back_s for s in scores for r in s.recoveries), default=math.nan),
        peak_over_bound=max(peaks, default=math.nan),
        foreseen_peak_ms=max(
            (1e3 * peak for score in scores for peak in _foreseeable(score)), default=math.nan
        ),
        worst_window=min(s.worst_window for s in scores),
        payload_ratio=payload_ratio,
        cpu_s=cpu_s,
    )


def _foreseeable(score: Score) -> list[float]:
    """Peaks (s) after falls that could be foreseen: three of the same kind came before, evenly spaced."""
    peaks, times_s = [], defaultdict[tuple[int, int], list[float]](list)
    for change in score.changes:
        if change.new_bps < change.old_bps:
            before = times_s[change.old_bps, change.new_bps]
            gaps_s = [later - earlier for earlier, later in pairwise([*before[-3:], change.at_s])]
            if len(gaps_s) == 3 and max(gaps_s) - min(gaps_s) < 0.1:
                peaks.append(change.peak_s)
            before.append(change.at_s)
    return peaks


def _middle(values: Iterable[float]) -> float:
    """The median; a reaction that never came counts as the longest."""
    known = [math.inf if math.isnan(value) else value for value in values]
    return median(known) if known else math.nan


def _is_lit(row: str) -> bool:
    """Whether the link always carries something; what a dark one could tell is not defined."""
    profile = ROWS[row].make(1)
    return all(b.rate_bps and b.loss_ratio < 1 for way in (profile.down, profile.up) for b in way.bands)


def _fly(job: tuple[str, str, int, float]) -> Figures:
    return fly(*job)


def run(jobs: list[tuple[str, str, int, float]], processes: int) -> list[Figures]:
    """All jobs, in their order."""
    if processes == 1 or len(jobs) == 1:
        return [fly(*job) for job in jobs]
    with multiprocessing.Pool(processes) as pool:
        return list(pool.imap(_fly, jobs))


def worst(figures: list[Figures]) -> dict[str, float]:
    """Of several seeds, per figure: the one that looks worst."""
    better_high = {"utilisation", "down_utilisation", "up_utilisation", "worst_window", "payload_ratio"}
    rows = [asdict(f) for f in figures]
    numbers = [name for name, value in rows[0].items() if isinstance(value, float)] + ["tail_drops"]
    return {name: (min if name in better_high else max)(r[name] for r in rows) for name in numbers}


def misses(row: Row, figures: dict[str, float]) -> set[str]:
    """The figures that miss their target."""
    missed = {"utilisation"} if figures["utilisation"] < row.utilisation else set()
    for name in ("p50_ms", "p95_ms", "long_ratio", "down_s", "up_s"):
        target = getattr(row, name)
        if target is not None and not figures[name] <= target:
            missed.add(name)
    return missed


COLUMNS = (
    ("use %", "utilisation", 100, 1),
    ("p50 ms", "p50_ms", 1, 0),
    ("p95", "p95_ms", 1, 0),
    ("p99", "p99_ms", 1, 0),
    ("max", "max_ms", 1, 0),
    (">100 %", "long_ratio", 100, 2),
    ("drops", "tail_drops", 1, 0),
    ("down s", "down_s", 1, 2),
    ("up s", "up_s", 1, 2),
    ("back s", "back_s", 1, 2),
    ("peak/bound", "peak_over_bound", 1, 2),
    ("foreseen", "foreseen_peak_ms", 1, 0),
    ("10 s %", "worst_window", 100, 0),
    ("payload %", "payload_ratio", 100, 1),
    ("CPU s", "cpu_s", 1, 1),
)


def print_table(document: dict[str, Any]) -> None:
    """The worst of the seeds in each place; what misses its target is marked."""
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    table = Table(title="Link estimation", title_justify="left", box=SIMPLE, padding=(0, 1, 0, 0))
    table.add_column("row, estimator", no_wrap=True)
    for heading, *_ in COLUMNS:
        table.add_column(heading, justify="right", no_wrap=True)
    for entry in document["rows"]:
        cells = []
        for _, name, factor, digits in COLUMNS:
            value = entry["worst"][name] * factor
            text = "-" if math.isnan(value) else f"{value:.{digits}f}"
            cells.append(f"[red]{text}*[/red]" if name in entry["misses"] else text)
        table.add_row(f"{entry['row']}, {entry['estimator']}", *cells)
    console = Console()
    console.width = max(console.width, 170)
    console.print(table)


def main() -> None:
    """Print the table, or JSON; either way leave the figures in out/bench/link_estimation.json."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", nargs="*", default=list(ROWS), choices=list(ROWS), metavar="ROW")
    parser.add_argument("--seeds", nargs="*", type=int, default=[1, 2, 3])
    parser.add_argument("--estimators", nargs="*", default=None, metavar="NAME")
    parser.add_argument("--minutes", type=float, default=MINUTES)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--ablation", action="store_true", help="ours, with each idea off in turn")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    known = [*estimators(), *sorted(TOLD)]
    for name in arguments.estimators or []:
        if name not in known:
            parser.error(f"--estimators {name}: expected of {', '.join(known)}")
    names = arguments.estimators or ["adaptive", "informed", "presets", "trials rule", "gradient"]
    if arguments.ablation:
        names = ["adaptive", *(name for name in estimators() if name.startswith("adaptive-"))]
    pairs = [(row, name) for name in names for row in arguments.rows if name not in TOLD or _is_lit(row)]
    jobs = [(row, name, seed, arguments.minutes) for row, name in pairs for seed in arguments.seeds]
    figures = run(jobs, arguments.processes)
    rows = []
    for row, name in pairs:
        own = [f for f in figures if (f.row, f.estimator) == (row, name)]
        summary = worst(own)
        rows.append(
            {
                "row": row,
                "estimator": name,
                "worst": summary,
                "misses": sorted(misses(ROWS[row], summary)),
                "seeds": [asdict(f) for f in own],
            }
        )
    document = {**provenance(), "minutes": arguments.minutes, "rows": rows}
    OUT.parent.mkdir(parents=True, exist_ok=True)
    OUT.write_text(json.dumps(document, indent=1))
    if arguments.json:
        print(OUT.read_text())
    else:
        print_table(document)


if __name__ == "__main__":
    main()

"""Every stack over every link with both loads, three seeds each: `make bench-peers` (root, about 55 minutes).

Several runs go side by side, each in namespaces of its own; a run needs about a tenth of a core. The order is
dealt so that no stack has quieter neighbours than another. Results: out/bench/peers.json.
"""

from __future__ import annotations

import argparse
import itertools
import json
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.progress import Progress

from bench.machine import provenance
from bench.peers.run import CONNECT_S, DRAIN_S, LOAD_S, Run
from bench.peers.summary import print_summary, summarise
from bench.peers.transport import PEERS

OUT = Path("out/bench/peers.json")
PROFILES = ("trials", "trials-swapped", "lossy-10", "blackout")
LOADS = ("camera-flood", "full")
SEEDS = (1, 2, 3)
_RUN_LIMIT_S = CONNECT_S + LOAD_S + DRAIN_S + 60
_TRIES = 2


def play(settings: Run) -> dict[str, Any]:
    """One run in a process of its own; one that cannot be had is a result too."""
    arguments = [f"--{name}={value}" for name, value in asdict(settings).items()]
    error = ""
    for _ in range(_TRIES):
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "run.json"
            command = [sys.executable, "-m", "bench.peers.run", *arguments, "--out", str(out)]
            try:
                done = subprocess.run(
                    command, capture_output=True, text=True, timeout=_RUN_LIMIT_S, check=False
                )
                if done.returncode == 0:
                    result: dict[str, Any] = json.loads(out.read_text())
                    return result
                error = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
            except subprocess.TimeoutExpired:
                error = f"not over after {_RUN_LIMIT_S:.0f} s"
    return {**asdict(settings), "error": error, "windows": []}


def main() -> int:
    """The matrix, or the part of it that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    names = [p.name for p in PEERS]
    parser.add_argument("--peer", action="append", choices=names, help="only these stacks")
    parser.add_argument("--profile", action="append", choices=PROFILES, help="only these links")
    parser.add_argument("--load", action="append", choices=LOADS, help="only these loads")
    parser.add_argument("--seeds", type=int, default=len(SEEDS))
    parser.add_argument("--jobs", type=int, default=6, help="runs side by side")
    parser.add_argument("--out", type=Path, default=OUT)
    a = parser.parse_args()
    runs = [
        Run(peer, profile, load, seed)
        for seed, load, profile, peer in itertools.product(
            range(1, a.seeds + 1), a.load or LOADS, a.profile or PROFILES, a.peer or names
        )
    ]
    results = []
    with ThreadPoolExecutor(a.jobs) as pool, Progress() as progress:
        task = progress.add_task("runs", total=len(runs))
        for result in pool.map(play, runs):
            results.append(result)
            progress.advance(task)
    document = {**provenance(), "runs": results}
    a.out.parent.mkdir(parents=True, exist_ok=True)
    a.out.write_text(json.dumps(document, indent=1))
    print_summary(summarise(results))
    failed = [r for r in results if "error" in r]
    for r in failed:
        print(
            f"{r['peer']} on {r['profile']} with {r['load']}, seed {r['seed']}: {r['error']}", file=sys.stderr
        )
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())

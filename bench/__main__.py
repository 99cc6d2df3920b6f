"""`make bench`: every bench that needs no root, figures under out/bench, then the page of them.

Two go side by side: those with real processes, which mostly wait, and those that compute, of which CPU time
is told.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

Command = tuple[str, ...]

COMPUTING: tuple[Command, ...] = (
    ("bench.mission",),
    ("bench.trials_rule", "--processes", "1"),
    ("bench.perception_accuracy",),
    ("bench.scale",),
    ("bench.soak",),
    ("bench.perception",),
    (
        *("bench.link_estimation", "--processes", "1", "--minutes", "3", "--seeds", "1", "2", "--rows"),
        *("trials", "trials-swapped", "lossy-10", "jitter-10", "blackouts-hold", "random", "constant-9600"),
    ),
)
LIVE: tuple[Command, ...] = (
    ("bench.live_mission",),
    ("bench.live_link", "--minutes", "2"),
    ("bench.wire_kill", "--kills", "10"),
    ("bench.calibration",),
    ("bench.perception_chain",),
    ("bench.ingest",),
    ("bench.wire_flood",),
    ("bench.wire_flood", "--initiations"),
    ("bench.codec",),
    ("bench.delta",),
    ("bench.encodings",),
    ("bench.view_codec",),
    ("bench.view_fuzz",),
)
"""The last five compute, so that both lanes end at about the same time."""


def main() -> int:
    """Run them all; the exit code says whether each ran to its end."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="*", metavar="NAME", help="as in bench.NAME")
    only = parser.parse_args().only
    lanes = [
        [command for command in lane if only is None or command[0].removeprefix("bench.") in only]
        for lane in (COMPUTING, LIVE)
    ]
    started_s = time.monotonic()
    with ThreadPoolExecutor(len(lanes)) as pool:
        failed = [name for names in pool.map(_run_lane, lanes) for name in names]
    failed += _run_lane([("bench.page",)])
    print(f"all in {(time.monotonic() - started_s) / 60:.1f} minutes")
    for name in failed:
        print(f"{name} failed", file=sys.stderr)
    return 1 if failed else 0


def _run_lane(commands: list[Command]) -> list[str]:
    """One after the other; what failed. Each prints when it is done, so that two do not mix."""
    failed = []
    for command in commands:
        started_s = time.monotonic()
        done = subprocess.run(
            [sys.executable, "-m", *command],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        took_s = time.monotonic() - started_s
        print(f"--- python -m {' '.join(command)}: {took_s:.0f} s\n{done.stdout}", flush=True)
        if done.returncode:
            failed.append(" ".join(command))
    return failed


if __name__ == "__main__":
    sys.exit(main())

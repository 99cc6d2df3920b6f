"""`make bench`: every bench that needs no root, one after the other; figures under out/bench."""

from __future__ import annotations

import subprocess
import sys

MODULES = (
    "bench.mission",
    "bench.scale",
    "bench.soak",
    "bench.codec",
    "bench.view_codec",
    "bench.view_fuzz",
    "bench.encodings",
    "bench.perception",
    "bench.perception_chain",
    "bench.delta",
    "bench.ingest",
    "bench.live_mission",
    "bench.calibration",
    "bench.page",
)


def main() -> int:
    """Run them all; the exit code says whether each ran to its end."""
    failed = [
        name for name in MODULES if subprocess.run([sys.executable, "-m", name], check=False).returncode
    ]
    for name in failed:
        print(f"{name} failed", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())

"""What virtual missions gave when it was last looked at: `python -m bench.baseline [--write]`.

The results are exact, the same on every machine, so any change is somebody's doing: CI compares, and who
means the change writes the new figures with `--write` and says why in the commit.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from netem_scripts.profiles import load_profile
from straitlink.mission import MissionSettings, load_named_or_file, run_mission

FILE = Path(__file__).with_name("baseline.json")
SEED = 1
# profile, load, virtual seconds
MISSIONS = (
    ("trials", "camera-flood", 130),
    ("trials-swapped", "camera-flood", 70),
    ("lossy-10", "camera-flood", 40),
    ("blackouts", "camera-flood", 65),
    ("trials", "light", 40),
    ("trials", "full", 30),
)
_LINK = ("utilisation", "queue_delay_p50_ms", "queue_delay_p95_ms", "queue_delay_max_ms")
_TOPIC = (
    "offered",
    "delivered",
    "superseded",
    "expired",
    "lost",
    "repeated_bytes",
    "age_p50_ms",
    "age_p95_ms",
)


def measure(profile: str, load: str, seconds: int) -> dict[str, Any]:
    """The figures of one mission that people care for, and a digest of every datagram."""
    settings = MissionSettings(load_profile(profile), load_named_or_file(load), seconds * 1_000_000_000, SEED)
    result = run_mission(settings)
    return {
        "link": {way: {n: row[n] for n in _LINK} for way, row in result["link"].items()},
        "topics": {key: {n: row[n] for n in _TOPIC} for key, row in result["topics"].items()},
        "trace_sha256": result["trace_sha256"],
    }


def results() -> dict[str, Any]:
    """All missions, by name."""
    return {mission_name(*mission): measure(*mission) for mission in MISSIONS}


def mission_name(profile: str, load: str, seconds: int) -> str:
    """How the file calls it."""
    return f"{profile} {load} {seconds} s"


def committed() -> dict[str, Any]:
    """The figures as they were when somebody last looked."""
    figures: dict[str, Any] = json.loads(FILE.read_text())
    return figures


def differences(was: Any, now: Any, where: str = "") -> Iterator[str]:
    """One line for each figure that is not the same."""
    if isinstance(was, dict) and isinstance(now, dict):
        for key in dict.fromkeys([*was, *now]):
            yield from differences(was.get(key), now.get(key), f"{where}.{key}" if where else str(key))
    elif was != now:
        yield f"{where}: {was} became {now}"


def main() -> int:
    """Compare, or write anew."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="these are the figures from now on")
    a = parser.parse_args()
    now = json.loads(json.dumps(results()))
    changed = list(differences(committed(), now)) if FILE.exists() else ["there was none"]
    for line in changed:
        print(line)
    if a.write:
        FILE.write_text(json.dumps(now, indent=1) + "\n")
        return 0
    return 1 if changed else 0


if __name__ == "__main__":
    sys.exit(main())

"""Where and of what figures were measured; stands at the head of every result."""

from __future__ import annotations

import json
import os
import platform
import shlex
import subprocess
import sys
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

_PACKAGES = (
    "eclipse-zenoh", "numpy", "numba", "opencv-python-headless", "protobuf", "zstandard", "zfec",
    "aioquic", "cyclonedds", "foxglove-sdk", "websockets",
)  # fmt: skip


OUT = Path("out/bench")


def keep(name: str, figures: dict[str, Any]) -> dict[str, Any]:
    """Leave figures as out/bench/NAME.json under where they come from; returns all of it."""
    origin = provenance()
    if clash := origin.keys() & figures.keys():
        raise ValueError(f"figures of {name}: {', '.join(sorted(clash))} would hide where they come from")
    document = {**origin, **figures}
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / f"{name}.json").write_text(json.dumps(document, indent=1) + "\n")
    return document


def provenance() -> dict[str, Any]:
    """commit (with + for uncommitted changes), command, time, machine, and versions of what is measured.

    load_average: of 1, 5 and 15 minutes when the bench ended, itself included; beyond the number of cores,
    others took part of the machine.
    """
    return {
        "commit": _git("rev-parse", "--short", "HEAD")
        + ("+" if _git("status", "--porcelain", "-uno") else ""),
        "command": _command(),
        "when": datetime.now(UTC).isoformat(timespec="minutes"),
        "load_average": [round(load, 2) for load in os.getloadavg()],
        "python": platform.python_version(),
        "machine": platform.machine(),
        "kernel": platform.release(),
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "tcp_congestion_control": _read("/proc/sys/net/ipv4/tcp_congestion_control"),
        "packages": {name: found for name in _PACKAGES if (found := _version(name))},
    }


def _command() -> str:
    """What was typed, so that it can be typed again."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    name = f"python -m {spec.name.removesuffix('.__main__')}" if spec else sys.argv[0]
    return " ".join([name, *map(shlex.quote, sys.argv[1:])])


def _git(*arguments: str) -> str:
    done = subprocess.run(["git", *arguments], capture_output=True, text=True, check=False)
    return done.stdout.strip()


def _cpu() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), "")


def _read(path: str) -> str:
    return Path(path).read_text().strip() if Path(path).exists() else ""


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""

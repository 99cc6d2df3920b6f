"""The walls of the project: one root, imports one way, a core without clocks or sockets."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("messages", "shaper", "perception_server", "netem_scripts", "straitlink")


def test_the_packages_come_from_this_repository() -> None:
    homes = {name: Path(str(importlib.import_module(name).__file__)).parent for name in PACKAGES}
    assert homes == {name: ROOT / name for name in PACKAGES}


def test_imports_point_one_way() -> None:
    linted = subprocess.run(
        [str(Path(sys.executable).parent / "lint-imports"), "--no-cache"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert linted.returncode == 0, linted.stdout + linted.stderr


def test_the_core_touches_no_clock_socket_thread_or_bus() -> None:
    linted = subprocess.run(
        [sys.executable, "-m", "ruff", "check", "--select", "TID251", *PACKAGES],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert linted.returncode == 0, linted.stdout + linted.stderr

"""One run of a stack over a link: `python -m bench.peers.run --peer zenoh-tcp --profile trials`."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from bench.peers.figures import link_figures, topic_figures, windows_of
from bench.peers.transport import PEERS
from netem_scripts.profiles import load_profile
from netem_scripts.records import BandRecord, PacketRecord
from netem_scripts.tun import TunSettings, run_tun
from straitlink.mission.load import load_named_or_file

CONNECT_S, LOAD_S, DRAIN_S = 10.0, 70.0, 12.0
PROFILES = Path(__file__).parent / "profiles"


@dataclass(frozen=True, slots=True)
class Run:
    """What is run. seed: of the link's chance."""

    peer: str
    profile: str
    load: str
    seed: int


def run(settings: Run) -> dict[str, Any]:
    """Play it through the link and measure. Needs root and /dev/net/tun. Raises RuntimeError."""
    profile = load_profile(PROFILES / f"{settings.profile}.toml")
    packets: list[PacketRecord] = []
    bands: list[BandRecord] = []
    with tempfile.TemporaryDirectory() as folder:
        outs = {side: Path(folder) / f"{side}.json" for side in ("robot", "operator")}
        begin_ns = time.monotonic_ns() + round(CONNECT_S * 1e9)
        commands = {side: _command(settings, side, begin_ns, out) for side, out in outs.items()}
        ended = run_tun(
            TunSettings(profile, commands["robot"], commands["operator"], settings.seed),
            on_packet=packets.append,
            on_band=bands.append,
        )
        if any(not out.exists() for out in outs.values()):
            raise RuntimeError(
                f"{settings}: a side ended early, exit codes {ended.robot_code}, {ended.operator_code}"
            )
        robot, operator = (json.loads(out.read_text()) for out in outs.values())
    load = load_named_or_file(settings.load)
    windows = windows_of(profile.down, bands[0].t_ns, begin_ns, begin_ns + round(LOAD_S * 1e9))
    return {
        **asdict(settings),
        "blocked_s": {"robot": robot["blocked_s"], "operator": operator["blocked_s"]},
        "windows": [
            {
                "name": window.name,
                "seconds": (window.end_ns - window.begin_ns) / 1e9,
                "topics": {k: asdict(v) for k, v in topic_figures(load, robot, operator, window).items()},
                "link": None if (link := link_figures(packets, window)) is None else asdict(link),
            }
            for window in windows
        ],
    }


def _command(settings: Run, side: str, begin_ns: int, out: Path) -> list[str]:
    return [
        sys.executable, "-m", "bench.peers.side", "--side", side, "--peer", settings.peer,
        "--load", settings.load, "--begin-ns", str(begin_ns), "--seconds", str(LOAD_S),
        "--drain", str(DRAIN_S), "--out", str(out),
    ]  # fmt: skip


def print_run(result: dict[str, Any]) -> None:
    """As a table, one line for each topic and window."""
    for window in result["windows"]:
        link = window["link"]
        used = (
            ""
            if link is None
            else (
                f"  link used {link['used']:.1%}, queue p50/p95/max "
                f"{link['queue_p50_ms']:.0f}/{link['queue_p95_ms']:.0f}/{link['queue_max_ms']:.0f} ms"
            )
        )
        print(f"{window['name']}{used}")
        for key, t in window["topics"].items():
            ages = " / ".join(
                "-" if t[k] is None else f"{t[k]:.0f}" for k in ("age_p50_ms", "age_p95_ms", "age_max_ms")
            )
            print(
                f"  {key:32} {t['in_window']:5} in time, {t['delivered']:5} of {t['offered']:5}   {ages} ms"
            )


def main() -> None:
    """One run, printed and written where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--peer", choices=[p.name for p in PEERS], required=True)
    parser.add_argument("--profile", default="trials")
    parser.add_argument("--load", default="camera-flood")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path)
    a = parser.parse_args()
    result = run(Run(a.peer, a.profile, a.load, a.seed))
    if a.out is not None:
        a.out.parent.mkdir(parents=True, exist_ok=True)
        a.out.write_text(json.dumps(result, indent=1))
    print_run(result)


if __name__ == "__main__":
    main()

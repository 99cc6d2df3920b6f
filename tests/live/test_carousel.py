"""The carousel between real processes: a link that is open now and then, and never back."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import tomlkit

from messages.attachment import Stamp
from netem_scripts.band import DirectionProfile, Profile
from netem_scripts.profile_file import profile_to_dict
from shaper.bus import open_bus
from tests.live.processes import ROOT, Rig, free_udp_port, wait_until
from tests.live.test_shapers import LOAD
from tests.mission.scenarios import band, both_ways

pytestmark = pytest.mark.live

OPEN_S, DARK_S, RATE_BPS = 0.5, 1.0, 20_000_000


def one_way() -> Profile:
    """20 Mbit/s for half a second, a second of nothing; never anything back."""
    windows = (band(OPEN_S, RATE_BPS, 1), band(DARK_S, RATE_BPS, 1, loss_ratio=1.0))
    never = DirectionProfile((band(60, RATE_BPS, 1, loss_ratio=1.0),), buffer_bytes=400_000)
    return Profile("windows", DirectionProfile(windows, cyclic=True, buffer_bytes=400_000), never)


@contextmanager
def second_link(rig: Rig, folder: Path) -> Iterator[Path]:
    """Beside the thin link of a rig, and in its configurations; its trace."""
    listen, entry, unused = (f"127.0.0.1:{free_udp_port()}" for _ in range(3))
    profile, trace = folder / "windows.toml", folder / "windows.jsonl"
    profile.write_text(tomlkit.dumps(profile_to_dict(one_way())))
    topics = [{"key": "robot/image/*"}, {"key": "robot/log", "keep": "all"}]
    send = {"peer": entry, "rate_bps": 18_000_000, "repeat_s": 0.25, "topics": topics}
    for side, table in (("robot", send), ("operator", {"listen": listen})):
        config: Any = tomlkit.parse((folder / f"{side}.toml").read_text())
        config["carousel"] = table
        (folder / f"{side}.toml").write_text(tomlkit.dumps(config))
    command = [sys.executable, "-m", "straitlink", "link", "--profile", str(profile), "--trace", str(trace)]
    command += ["--robot-side", entry, "--operator-side", unused, "--operator-peer", listen]
    process = subprocess.Popen(command, cwd=ROOT)
    try:
        wait_until(lambda: trace.exists() and trace.stat().st_size > 0, 15.0)
        yield trace
    finally:
        process.terminate()
        process.wait(10)


def test_what_goes_round_arrives_once_by_a_link_that_nothing_comes_back_on(tmp_path: Path) -> None:
    thin = both_ways(band(60, 9_600, 5))
    with Rig(tmp_path, thin, LOAD) as rig, second_link(rig, tmp_path) as trace:
        for name in ("robot", "operator", "link"):
            rig.start(name)
        robot, operator = open_bus(rig.bus("robot")), open_bus(rig.bus("operator"))
        came: list[tuple[str, bytes, int]] = []

        def on_sample(sample: Any) -> None:
            came.append((str(sample.key_expr), sample.payload.to_bytes(), time.time_ns()))

        subscriber = operator.declare_subscriber("robot/**", on_sample)
        pictures = {f"robot/image/{camera}": os.urandom(40_000) for camera in range(4)}
        logs = [b"log %d " % number + os.urandom(1000) for number in range(12)]
        try:
            publishers = {key: robot.declare_publisher(key) for key in (*pictures, "robot/log")}
            wait_until(lambda: all(bool(p.matching_status.matching) for p in publishers.values()))
            for number, log in enumerate(logs):  # in windows and in the dark
                publishers["robot/log"].put(log, attachment=Stamp(time.time_ns(), number).encode())
                time.sleep(0.1)
            for key, picture in pictures.items():
                publishers[key].put(picture)
            wait_until(lambda: len(came) >= len(pictures) + len(logs), 10.0)
            time.sleep(2 * (OPEN_S + DARK_S))  # two windows more: nothing comes twice
        finally:
            subscriber.undeclare()
            robot.close()
            operator.close()
        by_link = [json.loads(line) for line in trace.read_bytes().split(b"\n")[:-1]]
    assert sorted(payload for _, payload, _ in came) == sorted([*pictures.values(), *logs])
    assert all(payload == pictures[key] for key, payload, _ in came if key in pictures)
    packets = [record for record in by_link if record["event"] == "packet"]
    assert {record["direction"] for record in packets} == {"down"}
    assert sum(record["dropped"] is not None for record in packets) > 20  # the dark was met
    ledgers = [r for r in rig.records("robot") if r["event"] == "ledger"]
    ledger = [r for r in ledgers if "carousel_rounds" in r["datagrams"]][-1]
    assert ledger["topics"]["robot/log"]["sent"] == len(logs)
    assert ledger["datagrams"]["carousel_rounds"] > 4
    ages = [
        r["age_ns"] for r in rig.records("operator") if r["event"] == "delivered" and "image" in r["topic"]
    ]
    assert all(age is not None and -5e8 < age < 4e9 for age in ages)

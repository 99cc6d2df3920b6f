"""Two shaper daemons with real Zenoh buses and a real UDP link between them."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from messages.attachment import Stamp
from shaper.bus import open_bus
from shaper.traffic_class import DEFAULT_CLASSES
from straitlink.mission import Load, LoadTopic, MissionSettings, run_mission
from tests.live.processes import ROOT, Rig, free_udp_port, wait_until
from tests.mission.scenarios import S, band, both_ways

pytestmark = pytest.mark.live

PROFILE = both_ways(band(10, 1_000_000, 50), band(20, 100_000, 500), cyclic=True)
RUN_S = 30
LOAD = Load(
    "live",
    (
        LoadTopic("robot/heartbeat", "down", 64, 10, DEFAULT_CLASSES["heartbeat"]),
        LoadTopic("robot/joints", "down", 160, 20, DEFAULT_CLASSES["state"]),
        LoadTopic("robot/image", "down", 8000, 4, DEFAULT_CLASSES["perception"]),
        LoadTopic("operator/command", "up", 80, 10, DEFAULT_CLASSES["command"]),
    ),
)


def publish(rig: Rig, load: Load, seconds: float, stop: threading.Event | None = None) -> Counter[str]:
    """Put the load's messages on their buses, by absolute times."""
    sessions = {"down": open_bus(rig.bus("robot")), "up": open_bus(rig.bus("operator"))}
    try:
        publishers = {t.key: sessions[t.direction].declare_publisher(t.key) for t in load.topics}
        wait_until(lambda: all(p.matching_status.matching for p in publishers.values()))
        payloads = {t.key: np.random.default_rng(1).bytes(t.payload_bytes) for t in load.topics}
        due = sorted((n / t.rate_hz, t.key) for t in load.topics for n in range(int(seconds * t.rate_hz)))
        started_s = time.monotonic()
        sent: Counter[str] = Counter()
        for at_s, key in due:
            time.sleep(max(0.0, started_s + at_s - time.monotonic()))
            if stop is not None and stop.is_set():
                break
            publishers[key].put(payloads[key], attachment=Stamp(time.time_ns(), sent[key]).encode())
            sent[key] += 1
        return sent
    finally:
        for session in sessions.values():
            session.close()


def ages_ms(rig: Rig, load: Load) -> dict[str, list[float]]:
    """Ages at delivery per topic, from the receiving sides' traces."""
    ages: dict[str, list[float]] = {t.key: [] for t in load.topics}
    for side in ("robot", "operator"):
        for record in rig.records(side):
            if record["event"] == "delivered":
                ages[record["topic"]].append((record["age_ns"] or 0) / 1e6)
    return ages


ATTEMPTS = 3  # a host that stalls makes a run differ, a wrong model makes every run differ


@pytest.mark.exact
@pytest.mark.timeout(300)
def test_live_and_virtual_time_agree(tmp_path: Path) -> None:
    expected = run_mission(MissionSettings(PROFILE, LOAD, RUN_S * S, 1))["topics"]
    runs: list[list[str]] = []
    while len(runs) < ATTEMPTS and [] not in runs:
        folder = tmp_path / str(len(runs))
        folder.mkdir()
        runs.append(differences(folder, expected))
    assert [] in runs, f"each run differs: {runs}"


def differences(folder: Path, expected: dict[str, Any]) -> list[str]:
    """What a live run gives that virtual time does not: counts within 5 %, ages within 20 %."""
    with Rig(folder, PROFILE, LOAD) as rig:
        rig.start("robot")
        rig.start("operator")
        rig.start("link")  # last: its schedule begins now
        sent = publish(rig, LOAD, RUN_S)
        time.sleep(4)
    measured = ages_ms(rig, LOAD)
    found: list[str] = []

    def compare(what: str, value: float, wanted: object) -> None:
        if value != wanted:
            found.append(f"{what} is {value:.0f}, not {wanted}")

    for key, row in expected.items():
        compare(f"{key} offered", sent[key], pytest.approx(row["offered"], abs=1))
        compare(f"{key} delivered", len(measured[key]), pytest.approx(row["delivered"], rel=0.05))
        median_ms = float(np.percentile(measured[key], 50))
        compare(f"{key} age p50 in ms", median_ms, pytest.approx(row["age_p50_ms"], rel=0.20))
    ledger = last_ledger(rig, "robot")["robot/heartbeat"]
    # A stall of the machine by 100 ms lets one heartbeat replace another; none may be lost.
    kept = ledger["offered"] - ledger["superseded"]
    compare("heartbeats delivered", len(measured["robot/heartbeat"]), kept)
    compare("heartbeats kept", kept, pytest.approx(sent["robot/heartbeat"], rel=0.02))
    waits_ms = [r["queue_delay_ns"] / 1e6 for r in rig.records("link") if r["event"] == "packet"]
    if max(waits_ms) >= 2500:
        found.append(f"a datagram waited in the link for {max(waits_ms):.0f} ms")
    return found


@pytest.mark.parametrize("victim", ["robot", "operator"])
def test_a_killed_daemon_resumes_without_touching_the_other_side(tmp_path: Path, victim: str) -> None:
    other = "operator" if victim == "robot" else "robot"
    profile = both_ways(band(60, 1_000_000, 50))
    with Rig(tmp_path, profile, LOAD) as rig:
        for name in ("robot", "operator", "link"):
            rig.start(name)
        stop = threading.Event()
        publisher = threading.Thread(target=publish, args=(rig, LOAD, 40, stop))
        publisher.start()
        try:
            wait_until(lambda: delivered(rig, "operator") > 20 and delivered(rig, "robot") > 10)
            before = rig.pid(other)
            rig.kill(victim)
            rig.start(victim)
            counts = {side: delivered(rig, side) for side in ("robot", "operator")}
            wait_until(lambda: all(delivered(rig, side) > counts[side] + 10 for side in counts))
            assert rig.alive(other) and rig.pid(other) == before
            again = [r for r in rig.records(other) if r["event"] == "peer_started"]
            assert [r["again"] for r in again] == [False, True]
        finally:
            stop.set()
            publisher.join()


def last_ledger(rig: Rig, side: str) -> dict[str, Any]:
    """What a side says became of each topic's messages, when it stopped."""
    (*_, ledger) = [record["topics"] for record in rig.records(side) if record["event"] == "ledger"]
    return dict(ledger)


def delivered(rig: Rig, side: str) -> int:
    return sum(record["event"] == "delivered" for record in rig.records(side))


def test_the_encoding_and_capture_time_of_a_message_cross_the_link(tmp_path: Path) -> None:
    with Rig(tmp_path, both_ways(band(60, 1_000_000, 5)), LOAD) as rig:
        for name in ("robot", "operator", "link"):
            rig.start(name)
        robot, operator = open_bus(rig.bus("robot")), open_bus(rig.bus("operator"))
        got: list[Any] = []
        subscriber = operator.declare_subscriber("robot/**", got.append)
        try:
            publisher = robot.declare_publisher("robot/image", encoding="image/jpeg;mine")
            wait_until(lambda: bool(publisher.matching_status.matching))
            capture_ns = time.time_ns() - 250_000_000
            deadline_s = time.monotonic() + 10
            while not got and time.monotonic() < deadline_s:
                publisher.put(b"\xff\xd8 picture", attachment=Stamp(capture_ns, 7).encode())
                time.sleep(0.1)
            sample = got[0]
            assert str(sample.key_expr) == "robot/image"
            assert str(sample.encoding) == "image/jpeg;mine"
            assert sample.payload.to_bytes() == b"\xff\xd8 picture"
            stamp = int.from_bytes(sample.attachment.to_bytes()[:8], "little")
            assert abs(stamp - capture_ns) < 2_000_000  # the wire counts microseconds; clocks are the host's
        finally:
            subscriber.undeclare()
            robot.close()
            operator.close()


def test_a_port_in_use_is_one_line_and_exit_code_2(tmp_path: Path) -> None:
    with Rig(tmp_path, both_ways(band(60, 1_000_000, 5)), LOAD) as rig:
        rig.start("robot")
        again = subprocess.run(
            [sys.executable, "-m", "straitlink", "shaper", str(tmp_path / "robot.toml")],
            cwd=ROOT,
            capture_output=True,
            text=True,
            timeout=30,
            check=False,
        )
    assert again.returncode == 2
    last = again.stderr.strip().splitlines()[-1]
    assert last.startswith("straitlink: link.listen = 127.0.0.1:") and last.endswith("the port is in use")


def test_a_daemon_without_a_bus_or_a_peer_waits_and_stops_when_asked(tmp_path: Path) -> None:
    config = (ROOT / "examples" / "robot.toml").read_text()
    port = free_udp_port()
    config = config.replace("127.0.0.1:9001", f"127.0.0.1:{port}")
    config = config.replace(
        'listen = ["tcp/127.0.0.1:7447"]', f'connect = ["tcp/127.0.0.1:{free_udp_port()}"]'
    )
    path = tmp_path / "robot.toml"
    path.write_text(config)
    process = subprocess.Popen([sys.executable, "-m", "straitlink", "shaper", str(path)], cwd=ROOT)
    try:
        wait_until(lambda: is_taken(port), 15.0)
        time.sleep(1.5)  # tries the bus meanwhile
        assert process.poll() is None
        process.terminate()
        assert process.wait(10) == 0
    finally:
        process.kill()
        process.wait()


def is_taken(port: int) -> bool:
    """Whether a process has this UDP port; without trying it, which could take it from who wants it."""
    return f":{port:04X} " in Path("/proc/net/udp").read_text()

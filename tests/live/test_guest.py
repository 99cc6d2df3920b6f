"""A real kernel's netem in user-mode Linux: the command's output and code, and the daemons' outcome over it.

Run as a program it is one side in the guest: `python -m tests.live.test_guest SIDE FOLDER SECONDS`.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomlkit

from netem_scripts.guest import GuestError, check_guest
from netem_scripts.profiles import load_profile
from straitlink.mission import MissionSettings, run_mission
from straitlink.mission.mission import presets
from tests.live.processes import ROOT, Rig, wait_until
from tests.live.test_shapers import LOAD, ages_ms, publish
from tests.live.test_tun import Run, all_networks, why_no_namespaces

S = 1_000_000_000
RUN_S = 240
DRAIN_S = 15
PROFILE = "trials"


def why_not() -> str:
    try:
        check_guest()
    except GuestError as error:
        return str(error)
    return why_no_namespaces()


pytestmark = [
    pytest.mark.live,
    pytest.mark.guest,
    pytest.mark.timeout(240),
    pytest.mark.skipif(bool(why_not()), reason=why_not() or "it can"),
]


def guest(robot: list[str], operator: list[str], *options: str) -> list[str]:
    line = [sys.executable, "-m", "straitlink", "link", "--guest", *options]
    return [*line, "--", *robot, ":::", *operator]


def run_in_guest(
    robot: list[str], operator: list[str], *options: str, timeout_s: float = 90.0
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        guest(robot, operator, *options),
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=timeout_s,
        check=False,
    )


def test_output_and_exit_code_come_back_from_a_kernel_with_netem(tmp_path: Path) -> None:
    robot = f"echo out; echo err >&2; tc -j qdisc show dev link0 >{tmp_path}/qdisc; uname -r; exit 6"
    done = run_in_guest(["sh", "-c", robot], ["sleep", "5"], "--profile", "constant-1m-50ms")
    assert done.returncode == 6, done.stderr
    release = os.uname().release
    assert done.stdout.splitlines()[0] == "out" and done.stdout.splitlines()[1] != release
    assert done.stderr.splitlines() == ["err"]
    (qdisc,) = json.loads((tmp_path / "qdisc").read_text())
    assert qdisc["kind"] == "netem"
    assert qdisc["options"]["rate"]["rate"] == 125_000
    assert qdisc["options"]["delay"]["delay"] == 0.05


INTERFACE_STORY = """
import json, os, signal, subprocess, sys, time
folder = sys.argv[1]
link = [sys.executable, "-m", "straitlink", "link", "--tc", "--interface", "v0", "--direction", "up"]

def qdisc():
    text = subprocess.run(["tc", "-j", "qdisc", "show", "dev", "v0"], capture_output=True, text=True).stdout
    (found,) = json.loads(text)
    return found["kind"], round(found["options"].get("delay", {}).get("delay", 0) * 1000)

def until(wanted, seconds=20):
    end = time.monotonic() + seconds
    while (had := qdisc()) != wanted:
        assert time.monotonic() < end, f"{had}, not {wanted}"
        time.sleep(0.05)

def guard_of(pid):
    return int(open(f"/proc/{pid}/task/{pid}/children").read().split()[0])

subprocess.run("ip link add v0 type veth peer name v1; ip link set v0 up; ip link set v1 up", shell=True)
before = qdisc()
printed = subprocess.run([*link, "--profile", f"{folder}/steps.toml"], capture_output=True, text=True)
assert qdisc() == before and printed.stdout.count("tc qdisc") == 3, printed
for victim, number in (("link", signal.SIGTERM), ("link", signal.SIGKILL), ("guard", signal.SIGKILL)):
    process = subprocess.Popen([*link, "--profile", f"{folder}/steps.toml", "--apply"], stdout=subprocess.DEVNULL)
    until(("netem", 50))
    until(("netem", 200))
    until(("netem", 50))
    os.kill(process.pid if victim == "link" else guard_of(process.pid), number)
    code = process.wait(20)
    until(before)
    print(victim, number.name, code)
subprocess.run("tc qdisc add dev v0 root handle 5: pfifo limit 7", shell=True)
refused = subprocess.run([*link, "--profile", "trials", "--apply"], capture_output=True, text=True)
print(refused.returncode, refused.stderr.splitlines()[-1])
"""


def test_netem_on_an_interface_follows_the_schedule_and_goes_however_we_end(tmp_path: Path) -> None:
    band = "[[band]]\nduration_s = 2\nrate_bps = 1_000_000\none_way_delay_ms = "
    (tmp_path / "steps.toml").write_text(f"cyclic = true\nbuffer_s = 1\n{band}50\n{band}200\n")
    story = [sys.executable, "-c", INTERFACE_STORY, str(tmp_path)]
    code = "import json, sys\nfrom netem_scripts.guest import run_guest\nsys.exit(run_guest(json.loads(sys.argv[1]), 90))"
    done = subprocess.run(
        [sys.executable, "-c", code, json.dumps(story)],
        cwd=ROOT, capture_output=True, text=True, timeout=150, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    *ends, refused = done.stdout.splitlines()
    assert ends == ["link SIGTERM 0", "link SIGKILL -9", "guard SIGKILL 2"]
    assert refused.startswith("2 straitlink: v0: it has a qdisc of its own, pfifo 5:")


def spaces_of(pids: Iterable[int]) -> set[str]:
    """The process namespaces of some processes, bar our own."""
    found = set()
    for pid in pids:
        with suppress(OSError):
            found.add(os.readlink(f"/proc/{pid}/ns/pid"))
    return found - {os.readlink("/proc/self/ns/pid")}


def inside(spaces: set[str]) -> dict[int, str]:
    """Name by number of all processes in the namespaces; the guest's have lost the mark of the run."""
    found = {}
    for pid in (int(entry.name) for entry in Path("/proc").iterdir() if entry.name.isdigit()):
        with suppress(OSError):
            if os.readlink(f"/proc/{pid}/ns/pid") in spaces:
                found[pid] = Path(f"/proc/{pid}/comm").read_text().strip()
    return found


def test_every_profile_that_netem_can_have_is_applied_and_verified() -> None:
    for profile in ("trials", "lossy-10", "satellite", "lte-walk", "finals-slow"):
        done = run_in_guest(["true"], ["true"], "--profile", profile)
        assert (done.returncode, done.stderr) == (0, ""), profile


def test_the_guest_ends_by_itself_when_its_time_is_over() -> None:
    began_s = time.monotonic()
    done = run_in_guest(["sleep", "600"], ["sleep", "600"], "--timeout", "5")
    assert done.returncode == 124
    assert time.monotonic() - began_s < 60


def test_a_guest_whose_command_will_not_end_is_over_all_the_same() -> None:
    stubborn = "trap '' TERM; while :; do sleep 600; done"
    code = f"import sys\nfrom netem_scripts.guest import run_guest\nsys.exit(run_guest(['sh', '-c', {stubborn!r}], 2))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, timeout=90, check=False
    )
    assert done.returncode == 124, done.stderr


@pytest.mark.parametrize("victim", ["link", "boot"])
def test_nothing_of_the_guest_is_left_after_a_kill(victim: str) -> None:
    run = Run(guest(["sleep", "61"], ["sleep", "62"]))
    try:
        wait_until(lambda: len(spaces_of(run.processes())) == 1, 20.0)
        spaces, networks = spaces_of(run.processes()), run.networks() - {os.readlink("/proc/self/ns/net")}
        wait_until(lambda: list(inside(spaces).values()).count("linux.uml") > 4, 20.0)
        time.sleep(1)
        boot = min(pid for pid, name in inside(spaces).items() if name == "linux.uml")
        os.kill({"link": run.process.pid, "boot": boot}[victim], signal.SIGKILL)
        run.process.wait(20)
        wait_until(lambda: not run.processes() and not inside(spaces), 10.0)
        assert not networks & all_networks()
    finally:
        for pid in run.processes():
            os.kill(pid, signal.SIGKILL)


@pytest.mark.timeout(420)
def test_the_daemons_fare_alike_over_netem_over_the_proxy_and_in_virtual_time(tmp_path: Path) -> None:
    """By presets, so that what the link does is compared, and not what an estimator makes of its host."""
    settings = MissionSettings(load_profile(PROFILE), LOAD, RUN_S * S, 1, estimator=presets)
    expected = run_mission(settings)["topics"]
    with ThreadPoolExecutor() as both:  # each waits for most of the time
        runs = {
            "netem": both.submit(over_netem, tmp_path / "netem"),
            "proxy": both.submit(over_the_proxy, tmp_path / "proxy"),
        }
        measured = {way: run.result() for way, run in runs.items()}
    virtual = {key: (row["delivered"], row["age_p95_ms"]) for key, row in expected.items()}
    print("virtual", virtual)
    for way, (sent, ages) in measured.items():
        outcome = {key: (len(ages[key]), float(np.percentile(ages[key], 95))) for key in virtual}
        print(way, {key: (sent[key], *row) for key, row in outcome.items()})
    for way, (sent, ages) in measured.items():
        for key, (delivered, age_p95_ms) in virtual.items():
            assert sent[key] == pytest.approx(expected[key]["offered"], abs=2), (way, key)
            assert len(ages[key]) == pytest.approx(delivered, rel=0.05), (way, key)
            assert np.percentile(ages[key], 95) == pytest.approx(age_p95_ms, rel=0.25), (way, key)


Outcome = tuple[Counter[str], dict[str, list[float]]]


def over_the_proxy(folder: Path) -> Outcome:
    folder.mkdir()
    with Rig(folder, load_profile(PROFILE), LOAD, "presets") as rig:
        for name in ("robot", "operator", "link"):
            rig.start(name)
        sent = publish(rig, LOAD, RUN_S)
        time.sleep(DRAIN_S)
        return sent, ages_ms(rig, LOAD)


def over_netem(folder: Path) -> Outcome:
    folder.mkdir()
    rig = Rig(folder, load_profile(PROFILE), LOAD, "presets")
    for side, here, there in (("robot", 1, 2), ("operator", 2, 1)):
        path = folder / f"{side}.toml"
        document: Any = tomlkit.parse(path.read_text())
        document["link"] |= {"listen": f"10.71.0.{here}:9001", "peer": f"10.71.0.{there}:9001"}
        document["zenoh"]["listen"] = ["tcp/127.0.0.1:7447"]
        path.write_text(tomlkit.dumps(document))
    sides = [
        [sys.executable, "-m", "tests.live.test_guest", side, str(folder), str(RUN_S)]
        for side in ("robot", "operator")
    ]
    done = run_in_guest(*sides, "--profile", PROFILE, "--timeout", "330", timeout_s=400)
    assert done.returncode == 0, done.stdout + done.stderr
    sent: Counter[str] = Counter()
    for side in ("robot", "operator"):
        sent.update(json.loads((folder / f"{side}.sent.json").read_text()))
    return sent, ages_ms(rig, LOAD)


def one_side(side: str, folder: Path, seconds: int) -> None:
    """In the guest: a daemon and its publishers, until all has had time to arrive."""
    from messages.attachment import Stamp
    from shaper.bus import BusSettings, open_bus

    trace = folder / f"{side}.jsonl"
    daemon = subprocess.Popen(
        [sys.executable, "-m", "straitlink", "shaper", str(folder / f"{side}.toml"), "--trace", str(trace)]
    )
    wait_until(lambda: trace.exists() and trace.stat().st_size > 0, 30.0)
    session = open_bus(BusSettings(connect=["tcp/127.0.0.1:7447"]))
    topics = [topic for topic in LOAD.topics if topic.direction == ("down" if side == "robot" else "up")]
    publishers = {topic.key: session.declare_publisher(topic.key) for topic in topics}
    wait_until(lambda: all(bool(each.matching_status.matching) for each in publishers.values()), 30.0)
    payloads = {topic.key: np.random.default_rng(1).bytes(topic.payload_bytes) for topic in topics}
    due = sorted((n / t.rate_hz, t.key) for t in topics for n in range(int(seconds * t.rate_hz)))
    other = folder / ("operator.up" if side == "robot" else "robot.up")
    (folder / f"{side}.up").touch()
    wait_until(other.exists, 60.0)
    started_s = time.monotonic()
    sent: Counter[str] = Counter()
    for at_s, key in due:
        time.sleep(max(0.0, started_s + at_s - time.monotonic()))
        publishers[key].put(payloads[key], attachment=Stamp(time.time_ns(), sent[key]).encode())
        sent[key] += 1
    time.sleep(DRAIN_S)
    session.close()
    daemon.terminate()
    daemon.wait(20)
    (folder / f"{side}.sent.json").write_text(json.dumps(sent))


if __name__ == "__main__":
    one_side(sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]))

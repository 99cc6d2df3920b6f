"""Unmodified programs through the link, in namespaces of which nothing is left."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Sequence
from pathlib import Path

import pytest

from tests.live.processes import ROOT, wait_until


def why_no_namespaces() -> str:
    """Why this machine cannot run these tests; empty if it can."""
    if os.geteuid() != 0 or not os.access("/dev/net/tun", os.R_OK | os.W_OK):
        return "network namespaces and /dev/net/tun need root"
    tried = subprocess.run(
        ["unshare", "--net", "--pid", "--fork", "--mount-proc", "true"],
        capture_output=True,
        text=True,
        check=False,
    )
    return tried.stderr.strip()


pytestmark = [
    pytest.mark.live,
    pytest.mark.skipif(bool(why_no_namespaces()), reason=why_no_namespaces() or "it can"),
]

ECHO = """
import socket
server = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
server.bind(("10.71.0.2", 7000))
while True:
    data, address = server.recvfrom(2048)
    server.sendto(data, address)
"""
ROUND_TRIPS = """
import json, socket, time
probe = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
probe.settimeout(2)
time.sleep(0.5)
rtts = []
for _ in range(20):
    began = time.monotonic()
    probe.sendto(bytes(100), ("10.71.0.2", 7000))
    probe.recv(2048)
    rtts.append((time.monotonic() - began) * 1000)
print(json.dumps(sorted(rtts)))
"""
TCP_SINK = """
import json, socket, time
server = socket.create_server(("10.71.0.2", 7000))
connection, _ = server.accept()
total, times = 0, []
while data := connection.recv(65536):
    total += len(data)
    times.append((time.monotonic(), total))
(begin, first), (end, last) = times[0], times[-1]
print(json.dumps((last - first) * 8 / (end - begin)))
"""
TCP_SOURCE = """
import socket, time
time.sleep(0.5)
connection = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
connection.setsockopt(socket.IPPROTO_TCP, 13, b"reno")
connection.connect(("10.71.0.2", 7000))
connection.sendall(bytes(1_500_000))
connection.shutdown(socket.SHUT_WR)
connection.recv(1)
"""


def command(profile: str, robot: Sequence[str], operator: Sequence[str], *options: str) -> list[str]:
    line = [sys.executable, "-m", "straitlink", "link", "--profile", profile, "--tun", *options]
    return [*line, "--", *robot, ":::", *operator]


def through(
    profile: str, robot: Sequence[str], operator: Sequence[str], *options: str
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command(profile, robot, operator, *options),
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def python(text: str) -> list[str]:
    return [sys.executable, "-c", text]


@pytest.mark.exact
def test_a_datagram_takes_the_delay_and_its_serialisation_both_ways() -> None:
    done = through("constant-1m-50ms", python(ROUND_TRIPS), python(ECHO), "--linger", "0")
    assert done.returncode == 0, done.stderr
    rtts_ms = json.loads(done.stdout)
    expected_ms = 2 * (50 + 128 * 8 / 1000)
    assert expected_ms <= rtts_ms[0]
    assert rtts_ms[10] < expected_ms + 5


@pytest.mark.exact
@pytest.mark.skipif(shutil.which("ping") is None, reason="needs ping (apt-get install iputils-ping)")
def test_ping_shows_the_delay() -> None:
    done = through("constant-1m-50ms", ["ping", "-c", "5", "-i", "0.2", "10.71.0.2"], ["sleep", "3"])
    assert done.returncode == 0, done.stderr
    found = re.search(r"= [0-9.]+/([0-9.]+)/", done.stdout)
    assert found is not None and 101.3 <= float(found[1]) < 106


@pytest.mark.exact
def test_a_tcp_copy_gets_the_rate() -> None:
    done = through("constant-1m-50ms", python(TCP_SOURCE), python(TCP_SINK))
    assert done.returncode == 0, done.stderr
    assert (
        0.95e6 <= json.loads(done.stdout) <= 1_000_000 * 1448 / 1500 + 2_000
    )  # IP and TCP headers are charged


@pytest.mark.parametrize(
    ("robot", "operator", "code"),
    [
        ("exit 7", "sleep 60", 7),
        ("exit 0", "exit 5", 5),
        ("exit 3", "exit 5", 3),
        ("kill -TERM $$", "true", 128 + signal.SIGTERM),
        ("exit 0", "sleep 60", 0),
    ],
)
def test_the_exit_code_is_the_robot_s_then_the_operator_s(robot: str, operator: str, code: int) -> None:
    done = through("trials", ["sh", "-c", robot], ["sh", "-c", operator], "--linger", "0.5")
    assert done.returncode == code, done.stderr


def test_a_command_that_does_not_exist_is_named() -> None:
    done = through("trials", ["no-such-program"], ["true"])
    assert done.returncode == 127
    assert "no-such-program: No such file or directory" in done.stderr


def test_the_trace_tells_each_packet_with_its_ip_bytes(tmp_path: Path) -> None:
    trace = tmp_path / "link.jsonl"
    through("constant-1m-0ms", python(ROUND_TRIPS), python(ECHO), "--linger", "0", "--trace", str(trace))
    packets = [json.loads(line) for line in trace.read_text().splitlines() if '"packet"' in line]
    assert [p["wire_bytes"] for p in packets] == [128] * 40
    assert [p["direction"] for p in packets] == ["down", "up"] * 20


class Run:
    """A link with two long sleeps, known by a mark in the environment of all its processes."""

    def __init__(self, arguments: Sequence[str]) -> None:
        self.mark = f"LINK_TEST={uuid.uuid4()}"
        name, value = self.mark.split("=")
        self.process = subprocess.Popen(
            arguments, cwd=ROOT, env={**os.environ, name: value}, stderr=subprocess.DEVNULL
        )

    def processes(self) -> dict[int, str]:
        found = {}
        for entry in Path("/proc").iterdir():
            try:
                if entry.name.isdigit() and self.mark.encode() in (entry / "environ").read_bytes():
                    found[int(entry.name)] = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode()
            except OSError:
                continue
        return found

    def networks(self) -> set[str]:
        found = set()
        for pid in self.processes():
            try:
                found.add(os.readlink(f"/proc/{pid}/ns/net"))
            except OSError:
                continue
        return found


def all_networks() -> set[str]:
    found = set()
    for entry in Path("/proc").iterdir():
        try:
            found.add(os.readlink(entry / "ns" / "net"))
        except OSError:
            continue
    return found


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
@pytest.mark.parametrize("victim", ["link", "holder", "first", "program"])
def test_nothing_is_left_whichever_part_is_killed(victim: str, number: signal.Signals) -> None:
    host = os.readlink("/proc/self/ns/net")
    devices = sorted(os.listdir("/sys/class/net"))
    run = Run(command("trials", ["sleep", "61"], ["sh", "-c", "sleep 62 & sleep 63"], "--linger", "0"))
    try:
        wait_until(lambda: any(line.startswith("sleep 6") for line in run.processes().values()))
        wait_until(lambda: len(run.processes()) == 9)  # link, 2 holders, 2 first, sleep, sh, 2 sleeps of it
        ours = run.networks() - {host}
        assert len(ours) == 2
        holds = sorted(pid for pid, line in run.processes().items() if " hold " in line)
        robot_holds = [pid for pid in holds if " 10.71.0.1 " in run.processes()[pid]]
        program = next(pid for pid, line in run.processes().items() if line == "sleep 61 ")
        at = {"link": run.process.pid, "holder": robot_holds[0], "first": robot_holds[1], "program": program}
        os.kill(at[victim], number)
        code = run.process.wait(10)
        wait_until(lambda: not run.processes(), 5.0)
        wait_until(lambda: not ours & all_networks(), 5.0)
        assert sorted(os.listdir("/sys/class/net")) == devices
        expected = -number if (victim, number) == ("link", signal.SIGKILL) else 128 + number
        assert code == expected
    finally:
        for pid in run.processes():
            os.kill(pid, signal.SIGKILL)


@pytest.mark.parametrize("after_ms", range(0, 1000, 125))
def test_nothing_is_left_of_a_link_that_is_killed_while_it_starts(after_ms: int) -> None:
    before = all_networks()
    run = Run(command("trials", ["sleep", "61"], ["sleep", "62"]))
    try:
        time.sleep(after_ms / 1000)
        run.process.kill()
        run.process.wait()
        wait_until(lambda: not run.processes(), 5.0)
        wait_until(lambda: all_networks() <= before, 5.0)  # the kernel takes them down in its own time
    finally:
        for pid in run.processes():
            os.kill(pid, signal.SIGKILL)


def test_ctrl_c_reaches_the_commands_and_ends_the_link() -> None:
    run = Run(command("trials", ["sh", "-c", "trap 'exit 9' INT; sleep 61 & wait"], ["sleep", "62"]))
    try:
        wait_until(lambda: len(run.processes()) >= 8)
        run.process.send_signal(signal.SIGINT)
        assert run.process.wait(10) == 128 + signal.SIGINT
        wait_until(lambda: not run.processes(), 5.0)
    finally:
        for pid in run.processes():
            os.kill(pid, signal.SIGKILL)

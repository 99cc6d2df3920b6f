"""The demonstration as a user starts it, on a short log."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import uuid
from pathlib import Path

import pytest
from mcap.reader import make_reader

from straitlink.synthetic import SyntheticSettings, synthesize
from tests.live.processes import ROOT, marked_processes, wait_until

pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "light.mcap"
    synthesize(path, SyntheticSettings(duration_s=4, light=True))
    return path


MARK = f"STRAITLINK_TEST={uuid.uuid4()}"


def start(log: Path, out: Path, seconds: int) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "straitlink", "demo", "--log", str(log), "--out", str(out)]
    return subprocess.Popen(
        [*command, "--seconds", str(seconds)],
        cwd=ROOT,
        env=os.environ | dict([MARK.split("=")]),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def messages(recording: Path) -> dict[str, list[bytes]]:
    found: dict[str, list[bytes]] = {}
    with recording.open("rb") as stream:
        for _schema, channel, message in make_reader(stream).iter_messages():
            found.setdefault(channel.topic, []).append(message.data)
            assert message.log_time > message.publish_time  # arrival after capture
    return found


@pytest.fixture(scope="module")
def finished(log: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a demonstration that ran to its end."""
    out = tmp_path_factory.mktemp("finished") / "demo"
    process = start(log, out, 6)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 0, output
    assert not marked_processes(MARK)
    return out


def test_a_log_crosses_byte_for_byte_and_is_reported(log: Path, finished: Path) -> None:
    sent, got = messages_of_log(log), messages(finished / "operator.mcap")
    assert {"/robot/joint_states", "/robot/lidar/scan", "/robot/head_camera/image"} <= set(got)
    for topic, payloads in got.items():
        assert set(payloads) <= set(sent[topic]), topic
    page = (finished / "report.html").read_text()
    assert "robot/joint_states" in page and "http://" not in page.replace("http://www.w3.org", "")


def messages_of_log(log: Path) -> dict[str, list[bytes]]:
    found: dict[str, list[bytes]] = {}
    with log.open("rb") as stream:
        for _schema, channel, message in make_reader(stream).iter_messages():
            found.setdefault(channel.topic, []).append(message.data)
    return found


def test_ctrl_c_leaves_a_valid_recording_and_nothing_running(log: Path, tmp_path: Path) -> None:
    process = start(log, tmp_path / "demo", 60)
    recording = tmp_path / "demo" / "operator.mcap"
    wait_until(lambda: recording.exists() and recording.stat().st_size > 20_000, 40)
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=30)
    assert process.returncode == 0, output
    assert "stopped early" in output
    assert messages(recording)
    assert not marked_processes(MARK)


def test_killing_the_demonstration_stops_its_processes(log: Path, tmp_path: Path) -> None:
    process = start(log, tmp_path / "demo", 60)
    recording = tmp_path / "demo" / "operator.mcap"
    wait_until(lambda: recording.exists(), 40)
    time.sleep(1)
    assert len(marked_processes(MARK)) > 5  # the buses, the link, the shapers and more
    process.kill()
    process.communicate(timeout=10)
    wait_until(lambda: not marked_processes(MARK), 15)


def test_a_folder_of_somebody_else_s_files_is_left_alone(log: Path, tmp_path: Path) -> None:
    notes = tmp_path / "notes.log"
    notes.write_text("mine")
    process = start(log, tmp_path, 6)
    output, _ = process.communicate(timeout=30)
    assert process.returncode == 2 and "choose an empty folder with --out" in output
    assert notes.read_text() == "mine"


def test_a_mistake_costs_no_earlier_result(finished: Path, tmp_path: Path) -> None:
    out = finished
    recorded = (out / "operator.mcap").read_bytes()
    for mistaken in (tmp_path / "none.mcap", out / "operator.mcap"):
        process = start(mistaken, out, 5)
        output, _ = process.communicate(timeout=30)
        assert process.returncode == 2, output
        assert (out / "operator.mcap").read_bytes() == recorded

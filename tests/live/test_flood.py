"""Forged handshakes from a stranger while the peer is killed: it is back all the same, and at once."""

from __future__ import annotations

import os
import socket
import threading
import time
from pathlib import Path

import pytest

from messages.attachment import Stamp
from shaper.bus import open_bus
from shaper.handshake import INITIATION, INITIATION_BYTES
from shaper.key_file import read_key_file
from shaper.traffic_class import DEFAULT_CLASSES
from straitlink.demo.configs import KEY_FILE
from straitlink.mission import Load, LoadTopic
from tests.live.processes import Rig, wait_until
from tests.mission.scenarios import band, both_ways

pytestmark = pytest.mark.live

KEY = "robot/heartbeat"
LOAD = Load(
    "beats",
    (
        LoadTopic(KEY, "down", 64, 10, DEFAULT_CLASSES["heartbeat"]),
        LoadTopic("operator/command", "up", 40, 1, DEFAULT_CLASSES["command"]),
    ),
)


def flood(address: str, key_id: bytes, stop: threading.Event) -> None:
    """Some thousands a second: ten times as many as close the gate."""
    host, _, port = address.rpartition(":")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        while not stop.wait(0.005):
            for _ in range(20):
                forged = bytes([INITIATION]) + key_id + os.urandom(INITIATION_BYTES - 1 - len(key_id))
                stranger.sendto(forged, (host, int(port)))


def delivered(rig: Rig) -> int:
    return sum(record["event"] == "delivered" for record in rig.records("operator"))


def test_a_robot_that_is_killed_in_a_flood_of_forged_handshakes_is_heard_again(tmp_path: Path) -> None:
    stop = threading.Event()
    with Rig(tmp_path, both_ways(band(60, 1_000_000, 20)), LOAD) as rig:
        for name in ("robot", "operator", "link"):
            rig.start(name)
        target, key_id = rig.addresses.operator_shaper, read_key_file(tmp_path / KEY_FILE).id
        robot = open_bus(rig.bus("robot"))

        def beat() -> None:
            publisher = robot.declare_publisher(KEY)
            while not stop.wait(0.1):
                publisher.put(bytes(64), attachment=Stamp(time.time_ns(), 1).encode())

        threads = [
            threading.Thread(target=beat),
            threading.Thread(target=flood, args=(target, key_id, stop)),
        ]
        for thread in threads:
            thread.start()
        try:
            wait_until(lambda: delivered(rig) > 5, 20)
            for _ in range(2):
                rig.kill("robot")
                rig.start("robot")
                before = delivered(rig)
                wait_until(lambda before=before: delivered(rig) > before + 5, 20)  # type: ignore[misc]
        finally:
            stop.set()
            for thread in threads:
                thread.join()
        robot.close()

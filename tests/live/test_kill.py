"""kill -9 of live shapers: commands are given once or reported; `python -m bench.wire_kill` does more."""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from messages.attachment import Stamp
from shaper.bus import open_bus
from shaper.traffic_class import DEFAULT_CLASSES
from straitlink.mission import Load, LoadTopic
from tests.live.processes import Rig, wait_until
from tests.mission.scenarios import band, both_ways

pytestmark = pytest.mark.live

KEY = "operator/command"
LOAD = Load(
    "commands",
    (
        LoadTopic(KEY, "up", 40, 20, DEFAULT_CLASSES["command"]),
        LoadTopic("robot/heartbeat", "down", 64, 5, DEFAULT_CLASSES["heartbeat"]),
    ),
)


def test_commands_are_given_once_or_reported_when_either_shaper_is_killed(tmp_path: Path) -> None:
    with Rig(tmp_path, both_ways(band(60, 1_000_000, 20)), LOAD) as rig:
        for name in ("robot", "operator", "link"):
            rig.start(name)
        arrived: Counter[int] = Counter()
        told: dict[int, list[str]] = {}
        stop = threading.Event()
        sent: list[int] = []

        def on_command(sample: Any) -> None:
            arrived[int.from_bytes(sample.payload.to_bytes(), "little")] += 1

        def on_receipt(sample: Any) -> None:
            receipt = json.loads(sample.payload.to_bytes())
            told.setdefault(receipt["sequence"], []).append(receipt["stage"])

        robot, operator = open_bus(rig.bus("robot")), open_bus(rig.bus("operator"))
        kept = [robot.declare_subscriber(KEY, on_command)]
        kept.append(operator.declare_subscriber(f"@straitlink/receipt/{KEY}", on_receipt))

        def publish() -> None:
            publisher = operator.declare_publisher(KEY)
            while not stop.wait(0.05):
                sent.append(len(sent) + 1)
                stamp = Stamp(time.time_ns(), sent[-1]).encode()
                publisher.put(sent[-1].to_bytes(4, "little"), attachment=stamp)

        thread = threading.Thread(target=publish)
        thread.start()
        try:
            for victim in ("robot", "operator"):
                count = len(arrived)
                wait_until(lambda count=count: len(arrived) > count + 10, 20)  # type: ignore[misc]
                rig.kill(victim)
                rig.start(victim)
            count = len(arrived)
            wait_until(lambda: len(arrived) > count + 10, 20)
        finally:
            stop.set()
            thread.join()
        wait_until(lambda: not open_ended(sent, arrived, told), 12)  # a command lives for ten seconds
        time.sleep(1)  # for what might be given twice
        robot.close()
        operator.close()
    assert max(arrived.values()) == 1
    assert [n for n in sent if "delivered" in told.get(n, ()) and not arrived[n]] == []


def open_ended(sent: list[int], arrived: Counter[int], told: dict[int, list[str]]) -> list[int]:
    """Commands that were taken, that have not arrived, and of which nobody was told the end."""
    return [n for n in sent if n in told and not arrived[n] and set(told[n]) <= {"queued", "sent"}]

"""What a publisher can learn of its messages, on a real bus."""

from __future__ import annotations

import json
import threading
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest
import tomlkit

from messages.attachment import Stamp
from shaper.bus import open_bus
from tests.live.processes import Rig, wait_until
from tests.live.test_shapers import LOAD
from tests.mission.scenarios import band, both_ways

pytestmark = pytest.mark.live


def test_a_command_s_receipts_appear_on_the_bus_that_it_came_from(tmp_path: Path) -> None:
    with Rig(tmp_path, both_ways(band(60, 1_000_000, 50)), LOAD) as rig:
        for name in ("robot", "operator", "link"):
            rig.start(name)
        operator = open_bus(rig.bus("operator"))
        told: dict[int, list[str]] = defaultdict(list)
        documents: dict[str, Any] = {}

        def on_receipt(sample: Any) -> None:
            receipt = json.loads(sample.payload.to_bytes())
            told[receipt["sequence"]].append(receipt["stage"])

        def on_told(sample: Any) -> None:
            documents[str(sample.key_expr)] = json.loads(sample.payload.to_bytes())

        subscribers = [
            operator.declare_subscriber("@straitlink/receipt/operator/command", on_receipt),
            operator.declare_subscriber("@straitlink/*", on_told),
            operator.declare_subscriber("@straitlink/demand/**", on_told),
        ]
        try:
            publisher = operator.declare_publisher("operator/command")
            wait_until(lambda: bool(publisher.matching_status.matching))
            wait_until(lambda: any(r["event"] == "peer_started" for r in rig.records("operator")))
            for number in range(5):
                publisher.put(b"go", attachment=Stamp(time.time_ns(), number).encode())
                time.sleep(0.02)
            wait_until(lambda: [told[n][-1:] for n in range(5)] == [["delivered"]] * 5)
            assert all(told[n] == ["queued", "sent", "delivered"] for n in range(5))
            wait_until(lambda: {"@straitlink/ledger", "@straitlink/link"} <= documents.keys())
            wait_until(lambda: "@straitlink/demand/operator/command" in documents)
            demand = documents["@straitlink/demand/operator/command"]
            assert demand["budget_bytes"] > 50_000 and demand["period_ns"] == 1_000_000_000
        finally:
            for subscriber in subscribers:
                subscriber.undeclare()
            operator.close()


def test_a_pull_topic_is_asked_for_and_what_is_answered_crosses(tmp_path: Path) -> None:
    with Rig(tmp_path, both_ways(band(60, 100_000, 20)), LOAD) as rig:
        config = tomlkit.parse((tmp_path / "robot.toml").read_text())
        config["topics"].append({"key": "robot/view", "class": "perception", "max_hz": 2, "pull": True})  # type: ignore[union-attr]
        (tmp_path / "robot.toml").write_text(tomlkit.dumps(config))
        for name in ("robot", "operator", "link"):
            rig.start(name)
        robot, operator = open_bus(rig.bus("robot")), open_bus(rig.bus("operator"))
        asked: list[int] = []
        views: list[bytes] = []
        got = threading.Event()

        def answer(query: Any) -> None:
            budget_bytes = int(query.parameters["max_bytes"])
            asked.append(budget_bytes)
            query.reply("robot/view", b"v" * budget_bytes)

        def on_view(sample: Any) -> None:
            views.append(sample.payload.to_bytes())
            if len(views) >= 3:
                got.set()

        queryable = robot.declare_queryable("robot/view", answer)
        subscriber = operator.declare_subscriber("robot/view", on_view)
        try:
            assert got.wait(20), f"asked {asked}, came {len(views)}"
            assert all(256 <= budget <= 100_000 // 8 for budget in asked)
            assert {len(view) for view in views} <= set(asked)
        finally:
            queryable.undeclare()
            subscriber.undeclare()
            robot.close()
            operator.close()

"""The Trials in virtual time: what the operator feels while images saturate the link."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from straitlink.mission import run_mission
from tests.mission.scenarios import TraceLog, fly, settings

SEEDS = (1, 2, 3)


def test_the_same_seed_gives_the_same_result_to_the_byte() -> None:
    first, second = (fly("trials", "light", seconds=130, seed=5) for _ in range(2))
    assert first == second
    assert fly("trials", "light", seconds=130, seed=6)["trace_sha256"] != first["trace_sha256"]


@pytest.mark.parametrize("seed", SEEDS)
def test_every_heartbeat_arrives_and_is_young_in_the_thin_band(seed: int) -> None:
    trace = TraceLog()
    result = run_mission(settings("trials", "camera-flood", 240, seed), trace)
    heartbeat = result["topics"]["robot/heartbeat"]
    assert heartbeat["delivered"] == heartbeat["offered"] == 2400
    thin = [age for when_s, age in trace.deliveries("operator", "robot/heartbeat") if when_s % 120 >= 60]
    assert np.percentile(thin, 95) < 700
    assert max(thin) < 2500


@pytest.mark.parametrize("seed", SEEDS)
def test_the_buffer_holds_less_than_a_second_once_a_band_change_is_over(seed: int) -> None:
    result = fly("trials", "full", seconds=240, seed=seed)
    assert result["link"]["down"]["queue_delay_max_settled_ms"] < 1000
    assert result["link"]["down"]["buffer_drops"] == 0
    assert result["link"]["down"]["utilisation"] > 0.90


def test_the_thin_band_carries_as_many_images_as_arithmetic_leaves_room_for() -> None:
    topics = fly("constant-100k-500ms", seconds=30)["topics"]
    assert topics["robot/heartbeat"]["delivered"] == 300
    assert topics["robot/heartbeat"]["age_p95_ms"] < 650
    assert topics["robot/image"]["delivered"] >= 9
    assert topics["operator/command"]["delivered"] == 300


def test_the_fast_band_carries_everything_from_the_same_configuration() -> None:
    topics = fly("constant-1m-50ms", seconds=30)["topics"]
    assert topics["robot/image"]["delivered"] == topics["robot/image"]["offered"] == 60
    assert topics["robot/heartbeat"]["age_p95_ms"] < 90


@pytest.mark.parametrize("load", ["light", "full", "camera-flood"])
def test_every_offered_message_is_in_exactly_one_counter(load: str) -> None:
    for name, row in fly("trials", load, seconds=70)["topics"].items():
        assert row["offered"] == accounted(row), name
        assert min(value for value in row.values() if isinstance(value, int)) >= 0, name


def accounted(row: dict[str, Any]) -> int:
    counters = (
        "decimated",
        "superseded",
        "expired",
        "overflow",
        "delivered",
        "stale",
        "lost",
        "in_flight",
        "local",
    )
    return int(sum(row[counter] for counter in counters))


def test_ages_are_measured_without_synchronised_clocks() -> None:
    trace = TraceLog()
    result = run_mission(settings("constant-100k-500ms", "camera-flood", 60, 4), trace)
    measured = [age for _, age in trace.deliveries("operator", "robot/heartbeat")]
    true_ms = result["topics"]["robot/heartbeat"]["age_p50_ms"]
    assert abs(float(np.percentile(measured, 50)) - true_ms) < 25

"""Links that lose, repeat, overtake and go away, in virtual time."""

from __future__ import annotations

from dataclasses import replace

import pytest

from netem_scripts.profiles import load_profile
from straitlink.mission import run_mission
from straitlink.mission.mission import presets
from tests.mission.scenarios import TraceLog, band, both_ways, fly, settings, with_faults
from tests.mission.test_trials import accounted


def test_twenty_per_cent_of_loss_costs_twenty_per_cent_of_heartbeats_and_no_more() -> None:
    lossy = with_faults(load_profile("constant-1m-50ms"), loss_ratio=0.2)
    rows = [fly(lossy, seconds=120, seed=seed)["topics"]["robot/heartbeat"] for seed in (1, 2, 3)]
    offered = sum(row["offered"] for row in rows)
    assert sum(row["lost"] for row in rows) / offered == pytest.approx(0.2, abs=0.03)
    for row in rows:
        assert row["superseded"] <= 2 and row["expired"] == 0
        assert row["age_p95_ms"] < 90


def test_duplicates_and_overtaking_deliver_nothing_twice() -> None:
    messy = with_faults(
        load_profile("constant-1m-50ms"), duplicate_ratio=0.1, jitter_ns=20_000_000, reorder=True
    )
    for name, row in fly(messy, seconds=60)["topics"].items():
        assert row["delivered"] <= row["offered"], name
        assert row["offered"] == accounted(row), name


@pytest.mark.parametrize("held", [False, True], ids=["dropping", "holding the queue"])
def test_traffic_is_back_within_a_second_of_a_ten_second_blackout(held: bool) -> None:
    dark = band(10, 0, 50) if held else band(10, 1_000_000, 50, loss_ratio=1.0)
    profile = both_ways(band(20, 1_000_000, 50), dark, band(20, 1_000_000, 50))
    trace = TraceLog()
    run_mission(settings(profile, "camera-flood", 50, 1), trace)
    after = [when_s for when_s, _ in trace.deliveries("operator", "robot/image") if when_s > 30]
    assert after[0] < 31
    newest = [age for when_s, age in trace.deliveries("operator", "robot/heartbeat") if when_s > 32]
    assert max(newest) < 120


def test_nothing_stale_leaves_after_a_long_blackout() -> None:
    profile = both_ways(
        band(10, 1_000_000, 50), band(30, 1_000_000, 50, loss_ratio=1.0), band(10, 1_000_000, 50)
    )
    trace = TraceLog()
    result = run_mission(settings(profile, "camera-flood", 50, 2), trace)
    ages = [age for when_s, age in trace.deliveries("operator", "robot/joints") if when_s > 40]
    assert max(ages) < 1000
    command = result["topics"]["operator/command"]
    assert command["expired"] + command["overflow"] + command["lost"] > 200
    assert command["age_max_ms"] < 11_000  # the class lets a command live for 10 s


def test_jitter_does_not_make_a_sender_by_presets_change_its_mind() -> None:
    jittery = with_faults(load_profile("constant-1m-50ms"), jitter_ns=10_000_000)
    trace = TraceLog()
    run_mission(replace(settings(jittery, "camera-flood", 60, 1), estimator=presets), trace)
    bands = {r["band"] for r in trace.records["robot"] if r["event"] == "link_state"}
    assert bands == {"1000 kbit/s 50 ms"}

"""What leaves when, what is repeated, and what it costs, in virtual time."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest

from netem_scripts.band import Profile
from netem_scripts.profiles import load_profile
from straitlink.mission import MissionSettings, load_named_or_file, run_mission
from tests.mission.scenarios import S, TraceLog, band, both_ways, settings, with_faults
from tests.mission.test_trials import accounted

FAST, THIN, MIDDLE = (1_000_000, 50), (100_000, 500), (300_000, 200)  # bit/s, ms one way
MESSY = {"duplicate_ratio": 0.01, "jitter_ns": 5_000_000, "reorder": True}
RELIABLE = ("robot/plan", "operator/command", "operator/plan")

LOAD = """
[[topics]]
name = "robot/heartbeat"
direction = "down"
bytes = 64
rate_hz = 10
class = "heartbeat"
[[topics]]
name = "robot/joints"
direction = "down"
bytes = 160
rate_hz = 20
class = "state"
[[topics]]
name = "robot/plan"
direction = "down"
bytes = 600
rate_hz = 0.6666
class = "plan"
[[topics]]
name = "operator/command"
direction = "up"
bytes = 80
rate_hz = 10
class = "command"
[[topics]]
name = "operator/plan"
direction = "up"
bytes = 600
rate_hz = 0.6666
class = "plan"
"""
IMAGES = """
[[topics]]
name = "robot/image"
direction = "down"
bytes = 20000
rate_hz = 2
class = "perception"
"""


class Flight:
    """A mission with the loads above, and what its traces say."""

    def __init__(self, profile: Profile, seconds: float, seed: int = 1, load: str = LOAD) -> None:
        with TemporaryDirectory() as folder:
            path = Path(folder) / "load.toml"
            path.write_text(load)
            parsed = load_named_or_file(str(path))
        self.trace = TraceLog()
        self.result = run_mission(MissionSettings(profile, parsed, int(seconds * S), seed), self.trace)

    @property
    def topics(self) -> dict[str, Any]:
        topics: dict[str, Any] = self.result["topics"]
        return topics

    def numbers(self, side: str, topic: str) -> list[int]:
        """Numbers of the messages as they were delivered."""
        records = self.trace.records[side]
        return [int(str(r["number"])) for r in records if r["event"] == "delivered" and r["topic"] == topic]


def receiver_of(topic: str) -> str:
    return "operator" if topic.startswith("robot") else "robot"


# Loss, reordering and duplication (point 2).


@cache
def lossy_flight(loss_ratio: float, seed: int) -> Flight:
    """Two minutes over a fast link that also duplicates and reorders."""
    lossy = with_faults(load_profile("constant-1m-50ms"), loss_ratio=loss_ratio, **MESSY)
    return Flight(lossy, 120, seed, LOAD + IMAGES)


@pytest.mark.parametrize("loss_ratio", [0.1, 0.2])
@pytest.mark.parametrize("seed", [1, 2])
def test_over_a_lossy_link_what_must_arrive_does_once_in_order_and_cheaply(
    loss_ratio: float, seed: int
) -> None:
    flight = lossy_flight(loss_ratio, seed)
    repeated = sent = 0
    for topic in RELIABLE:
        row = flight.topics[topic]
        assert row["delivered"] == row["offered"], topic
        assert flight.numbers(receiver_of(topic), topic) == list(range(row["offered"])), topic
        repeated += row["repeated_bytes"]
        sent += row["sent_bytes"] + row["repeated_bytes"]
    assert 0 < repeated <= 1.3 * loss_ratio * sent


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_at_a_tenth_of_loss_nineteen_of_twenty_images_arrive_for_less_than_a_third_more(seed: int) -> None:
    row = lossy_flight(0.1, seed).topics["robot/image"]
    started = row["delivered"] + row["lost"] + row["stale"]
    assert started > 200
    assert row["delivered"] >= 0.95 * started
    assert row["repeated_bytes"] <= 0.30 * row["sent_bytes"]


@pytest.mark.parametrize("profile", ["constant-1m-50ms", "constant-100k-500ms"])
def test_a_link_that_loses_nothing_carries_no_parity_and_repeats_nothing(profile: str) -> None:
    flight = Flight(with_faults(load_profile(profile), **MESSY), 120, 1, LOAD + IMAGES)
    for name, row in flight.topics.items():
        assert row["repeated_bytes"] == 0, name
        assert row["lost"] == 0, name


# Blackouts (point 3).


def blackout(rate_bps: int, delay_ms: int, held: bool) -> Profile:
    """30 s of nothing from second 10 on; a link that holds keeps what waits in its buffer."""
    dark = band(30, 0, delay_ms) if held else band(30, rate_bps, delay_ms, loss_ratio=1.0)
    return both_ways(band(10, rate_bps, delay_ms), dark, band(20, rate_bps, delay_ms), buffer_s=40)


@cache
def dark_flight(rate_bps: int, delay_ms: int, held: bool, seed: int = 1) -> Flight:
    return Flight(blackout(rate_bps, delay_ms, held), 60, seed)


@pytest.mark.parametrize("link", [FAST, THIN, MIDDLE], ids=["fast", "thin", "middle"])
@pytest.mark.parametrize(("held", "seed"), [(False, 1), (False, 2), (True, 1), (True, 2)])
def test_twenty_plans_of_a_blackout_arrive_once_in_order_and_within_three_round_trips(
    link: tuple[int, int], held: bool, seed: int
) -> None:
    """... and their own transmission time, though a link that held its queue serves what that holds first."""
    rate_bps, delay_ms = link
    flight = dark_flight(rate_bps, delay_ms, held, seed)
    for topic in ("robot/plan", "operator/plan"):
        side = receiver_of(topic)
        assert flight.numbers(side, topic) == list(range(40)), topic
        deliveries = flight.trace.deliveries(side, topic)
        dark = [when_s for when_s, age_ms in deliveries if 10 < when_s - age_ms / 1000 < 39.9]
        transmission_s = 20 * (600 + 10 + 28 + 10) * 8 / (0.95 * rate_bps)
        assert 19 <= len(dark) <= 20
        assert max(dark) - 40 < 3 * 2 * delay_ms / 1000 + transmission_s, topic


@pytest.mark.parametrize("link", [FAST, THIN], ids=["fast", "thin"])
def test_after_a_blackout_the_newest_state_comes_and_nothing_stale(link: tuple[int, int]) -> None:
    rate_bps, delay_ms = link
    flight = dark_flight(rate_bps, delay_ms, held=False)
    for topic in ("robot/heartbeat", "robot/joints"):
        after = [(w, age) for w, age in flight.trace.deliveries("operator", topic) if w > 40]
        assert after[0][0] - 40 < 4 * 2 * delay_ms / 1000, topic
        assert max(age for _, age in after) < delay_ms + 200, topic


@pytest.mark.parametrize("held", [False, True], ids=["dropping", "holding the queue"])
def test_commands_that_expired_in_the_dark_are_reported_and_the_rest_delivered(held: bool) -> None:
    seldom = LOAD.replace('rate_hz = 10\nclass = "command"', 'rate_hz = 2\nclass = "command"')
    flight = Flight(blackout(*FAST, held), 60, load=seldom)  # so that they expire, and are not shed
    row = flight.topics["operator/command"]
    numbers = flight.numbers("robot", "operator/command")
    assert numbers == sorted(set(numbers))
    assert row["delivered"] + row["expired"] + row["overflow"] == row["offered"] == 120
    assert row["lost"] == row["in_flight"] == 0
    assert row["age_max_ms"] <= 10_010
    stages: dict[str, int] = {}
    for record in flight.trace.records["operator"]:
        if record["event"] == "receipt" and record["topic"] == "operator/command":
            stage = str(record["stage"])
            stages[stage] = stages.get(stage, 0) + 1
    assert stages["delivered"] == row["delivered"]
    assert stages["expired"] == row["expired"] > 0
    assert stages.get("shed", 0) == row["overflow"]


# The ledger and the seed (point 5).


@pytest.mark.parametrize("seed", [1, 2])
def test_every_message_is_in_exactly_one_counter_whatever_the_link_did(seed: int) -> None:
    lossy = with_faults(blackout(*FAST, held=False), duplicate_ratio=0.02)
    for name, row in Flight(lossy, 60, seed, LOAD + IMAGES).topics.items():
        assert row["offered"] == accounted(row), name
        assert min(value for value in row.values() if isinstance(value, int)) >= 0, name


def test_the_same_seed_gives_the_same_trace_with_everything_going_wrong() -> None:
    lossy = with_faults(load_profile("constant-1m-50ms"), loss_ratio=0.15, **MESSY)
    runs = [Flight(lossy, 40, seed, LOAD + IMAGES) for seed in (7, 7, 8)]
    assert runs[0].result == runs[1].result
    assert runs[0].trace.records == runs[1].trace.records
    assert runs[0].result["trace_sha256"] != runs[2].result["trace_sha256"]


@pytest.mark.parametrize(
    ("profile", "images", "heartbeat_p95_ms", "joints_p95_ms", "command_p95_ms"),
    [("constant-100k-500ms", 9, 650, 700, 600), ("constant-1m-50ms", 60, 90, 250, 150)],
)
def test_the_camera_flood_keeps_its_figures(
    profile: str, images: int, heartbeat_p95_ms: int, joints_p95_ms: int, command_p95_ms: int
) -> None:
    """Point 1."""
    topics = run_mission(settings(profile, "camera-flood", 30, 1))["topics"]
    assert topics["robot/heartbeat"]["delivered"] == 300
    assert topics["robot/heartbeat"]["age_p95_ms"] < heartbeat_p95_ms
    assert topics["robot/joints"]["delivered"] >= 0.95 * topics["robot/joints"]["offered"]
    assert topics["robot/joints"]["age_p95_ms"] < joints_p95_ms
    assert topics["robot/image"]["delivered"] >= images
    assert topics["operator/command"]["delivered"] == 300
    assert topics["operator/command"]["age_p95_ms"] < command_p95_ms

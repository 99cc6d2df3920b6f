"""The adaptive estimator on links that nobody has announced; the full table is bench.link_estimation."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import pytest

from netem_scripts.band import Band, DirectionProfile, Profile
from netem_scripts.trials import TRIALS_BUFFER_NS
from straitlink.mission import run_mission
from straitlink.mission.mission import adaptive
from tests.mission.scenarios import TraceLog, band, both_ways, settings


@cache
def fly(profile: str) -> tuple[dict[str, Any], TraceLog]:
    """130 s with always something to send: what the link saw, and what the sides say."""
    trace = TraceLog()
    mission = replace(settings(profile, "backlogged", 130, 1), estimator=adaptive)
    return run_mission(mission, trace)["link"], trace


@pytest.mark.parametrize(("profile", "use", "p95_ms"), [("trials", 0.96, 65), ("lossy-10", 0.95, 100)])
def test_without_presets_the_link_is_filled_and_its_queue_is_not(
    profile: str, use: float, p95_ms: float
) -> None:
    for way in fly(profile)[0].values():
        assert way["utilisation"] > use
        assert way["queue_delay_p95_ms"] < p95_ms
        assert way["buffer_drops"] == 0


def test_the_rate_follows_the_link_within_a_second_and_a_half_of_its_change() -> None:
    _, trace = fly("trials")
    states = [(int(str(r["t_ns"])) / 1e9, r) for r in trace.records["robot"] if r["event"] == "link_state"]
    for at_s, true_bps in ((58.0, 1e6), (62.5, 1e5), (118.0, 1e5), (121.5, 1e6)):
        _, state = [s for s in states if s[0] <= at_s][-1]
        assert float(str(state["rate_bps"])) == pytest.approx(true_bps, rel=0.06), at_s


def test_a_link_that_carries_little_stays_known_and_the_first_image_leaves_at_its_rate() -> None:
    flood = settings("constant-100k-500ms", "camera-flood", 28, 1)
    late = {"robot/image": 20_000_000_000, "robot/joints": 10_000_000_000}
    topics = tuple(replace(t, starts_at_ns=late.get(t.key, 0)) for t in flood.load.topics)
    trace = TraceLog()
    run_mission(replace(flood, load=replace(flood.load, topics=topics), estimator=adaptive), trace)
    first_s = min(when_s for when_s, _ in trace.deliveries("operator", "robot/image"))
    assert 21 < first_s < 24
    for record in trace.records["robot"]:
        if record["event"] == "link_state" and 8e9 < int(str(record["t_ns"])) < 20e9:
            assert float(str(record["rate_bps"])) == pytest.approx(1e5, rel=0.06)
            assert record["band"] not in ("hold", "probe")


def steps(*bands: tuple[float, int, int], loss_ratio: float = 0.0) -> Profile:
    """A link, alike both ways. bands: for how long (s), rate (bit/s), one-way delay (ms)."""
    direction = DirectionProfile(
        tuple(Band(round(s * 1e9), bps, ms * 1_000_000, loss_ratio=loss_ratio) for s, bps, ms in bands),
        cyclic=True,
        buffer_ns=TRIALS_BUFFER_NS,
    )
    return Profile("steps", direction, direction)


def parted(down: Profile, up: Profile) -> Profile:
    """Another link each way."""
    return replace(down, up=up.down)


@pytest.mark.parametrize(("seed", "loss_ratio"), [(4, 0.0), (3, 0.05), (4, 0.05)])
def test_a_band_of_about_the_old_rate_but_a_longer_delay_is_filled_at_once(
    seed: int, loss_ratio: float
) -> None:
    """Its rate alone cannot tell it from the old one, whose delay would make the new one's look like queue."""
    down = steps((24, 2_990_000, 42), (20, 2_654_000, 318), loss_ratio=loss_ratio)
    up = steps((24, 82_000, 102), (20, 73_000, 22), loss_ratio=loss_ratio)
    mission = replace(settings("trials", "backlogged", 43, seed), profile=parted(down, up))
    assert run_mission(replace(mission, estimator=adaptive))["link"]["down"]["utilisation"] > 0.95


@pytest.mark.parametrize(("seed", "loss_ratio"), [(2, 0.0), (4, 0.0), (1, 0.05)])
def test_the_end_of_a_long_queue_is_known_though_the_change_was_earlier_than_it_seemed(
    seed: int, loss_ratio: float
) -> None:
    """The peer's words of before the change come together with those of after it: the way back is faster too."""
    down = steps((22, 1_492_000, 502), (25, 95_000, 102), loss_ratio=loss_ratio)
    up = steps((22, 241_000, 551), (25, 65_000, 104), loss_ratio=loss_ratio)
    mission = replace(settings("trials", "backlogged", 39, seed), profile=parted(down, up))
    trace = TraceLog()
    run_mission(replace(mission, estimator=adaptive), trace)
    ages_ms = [age for when, age in trace.deliveries("operator", "robot/heartbeat") if when > 36]
    assert len(ages_ms) > 15
    assert max(ages_ms) < 102 + 300


def test_trains_fill_no_buffer_of_a_link_that_has_become_thinner_than_ever_before() -> None:
    """It has shown 500 kbit/s as its slowest, and falls from 900 to 55: 1.1 s of queue before anyone can know."""
    profile = steps((20, 500_000, 200), (25, 900_000, 70), (20, 55_000, 400))
    mission = settings("trials", "backlogged", 64, 1)
    result = run_mission(replace(mission, profile=profile, estimator=adaptive))["link"]
    assert max(way["queue_delay_max_ms"] for way in result.values()) < 2_500


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_rise_is_found_though_all_that_leaves_meanwhile_is_what_must_pass(seed: int) -> None:
    """A tenth of the thin rate is less than heartbeats need, so that trains wait for them."""
    profile = steps((20, 80_000, 100), (30, 2_000_000, 450), loss_ratio=0.05)
    mission = settings("trials", "backlogged", 49, seed)
    result = run_mission(replace(mission, profile=profile, estimator=adaptive))["link"]
    assert min(way["utilisation"] for way in result.values()) > 0.8


@pytest.mark.parametrize("delay_ms", [388, 418, 448])
def test_a_link_whose_new_delay_and_queue_are_what_its_delay_was_is_not_taken_for_the_old_one(
    delay_ms: int,
) -> None:
    """2.1 s of queue before anyone can know; it was 7.9 s while nothing looked at what came afterwards."""
    profile = steps((24, 1_794_000, 503), (10, 367_000, delay_ms), loss_ratio=0.05)
    mission = settings("trials", "backlogged", 33, 2)
    result = run_mission(replace(mission, profile=profile, estimator=adaptive))["link"]
    assert max(way["queue_delay_max_ms"] for way in result.values()) < 2_700


@pytest.mark.parametrize("seed", [1, 2])
def test_a_thin_link_that_has_held_its_queue_is_used_before_a_report_could_say_that_it_is_the_same(
    seed: int,
) -> None:
    """The peer's datagrams of that time come as fast as the way back serves them."""
    dark = steps((20, 100_000, 500), (10, 0, 500), (60, 100_000, 500))
    mission = settings("trials", "backlogged", 40, seed)
    trace = TraceLog()
    run_mission(replace(mission, profile=dark, estimator=adaptive), trace)
    entered = [r for r in trace.records["link"] if r["event"] == "packet" and r["direction"] == "down"]
    bits = sum(8 * int(str(r["wire_bytes"])) for r in entered if 20e9 <= int(str(r["t_ns"])) < 33e9)
    assert bits > 0.88 * 3 * 100_000, "of what it could serve in its first three seconds; 0.82 to 0.86 else"


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_thin_link_that_was_dark_is_used_as_before_once_the_peer_is_heard(seed: int) -> None:
    """A trickle's datagram is smaller than those before the darkness: it is its delay that tells."""
    dark = both_ways(band(20, 100_000, 500), band(10, 100_000, 500, loss_ratio=1.0), band(60, 100_000, 500))
    trace = TraceLog()
    run_mission(replace(settings(dark, "backlogged", 40, seed), estimator=adaptive), trace)
    entered = [r for r in trace.records["link"] if r["event"] == "packet" and r["direction"] == "down"]
    bits = sum(8 * int(str(r["wire_bytes"])) for r in entered if 30.85e9 <= int(str(r["t_ns"])) < 31.35e9)
    assert bits > 0.85 * 50_000, "a report could say so at 31.2 s"


@pytest.mark.parametrize("seed", [2, 3])
def test_a_datagram_of_the_peers_that_is_late_is_news_though_loss_may_have_taken_it(seed: int) -> None:
    """The way back takes 150 ms longer; with loss so short a silence is none, and 4.6 s of queue gathered."""
    down = both_ways(band(20, 340_000, 480, loss_ratio=0.05), band(20, 60_000, 200, loss_ratio=0.05))
    up = both_ways(band(20, 64_000, 240, loss_ratio=0.05), band(20, 550_000, 390, loss_ratio=0.05))
    mission = settings(replace(down, up=up.up), "backlogged", 39, seed)
    result = run_mission(replace(mission, estimator=adaptive))["link"]
    assert result["down"]["queue_delay_max_ms"] < 2_500


def test_a_link_that_has_held_its_queue_and_comes_back_thinner_is_not_filled() -> None:
    """A second and a half of the old rate would fill its buffer."""
    thinner = steps((20, 1_000_000, 50), (10, 0, 50), (60, 100_000, 500))
    mission = settings("trials", "backlogged", 45, 1)
    trace = TraceLog()
    run_mission(replace(mission, profile=thinner, estimator=adaptive), trace)
    entered = [r for r in trace.records["link"] if r["event"] == "packet" and r["direction"] == "down"]
    bits = sum(8 * int(str(r["wire_bytes"])) for r in entered if 30e9 <= int(str(r["t_ns"])) < 32e9)
    assert bits < 1.5 * 2 * 100_000

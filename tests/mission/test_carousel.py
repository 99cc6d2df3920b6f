"""The Finals' two links: the thin one carries what must arrive, the carousel serves the one without a way back."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from netem_scripts.band import Profile
from netem_scripts.profiles import load_profile
from shaper.errors import ConfigError
from straitlink.mission import load_named_or_file, run_mission
from straitlink.mission.carousel import CarouselPlan
from tests.mission.scenarios import TraceLog, settings, with_faults

GOES_ROUND = (
    "robot/head_camera/image",
    "robot/chest_camera/image",
    "robot/lidar/scan",
    "robot/joint_states_full",
)
SECONDS = 12.0


def fly(
    fast: Profile | None,
    rate_bps: int = 0,
    trace: TraceLog | None = None,
    seed: int = 1,
    seconds: float = SECONDS,
) -> dict[str, Any]:
    mission = settings("finals-slow", "finals", seconds, seed)
    plan = None if fast is None else CarouselPlan(fast, rate_bps)
    return run_mission(replace(mission, carousel=plan), trace)


def windows_s(profile: Profile) -> list[float]:
    """When the fast link opens, within the mission, with a whole second ahead."""
    begins, at_s = [], 0.0
    for band in profile.down.bands:
        begins += [at_s] if band.loss_ratio < 1 and at_s + 1 <= SECONDS else []
        at_s += band.duration_ns / 1e9
    return begins


@pytest.mark.parametrize("seed", [1, 5])
def test_every_window_brings_the_newest_of_everything_at_once(seed: int) -> None:
    fast, trace = load_profile(f"finals-fast-{seed}"), TraceLog()
    fly(fast, trace=trace, seed=seed)
    opens_s = windows_s(fast)
    assert len(opens_s) >= 2
    for key in GOES_ROUND:
        deliveries = trace.deliveries("operator", key)
        period_s = {"robot/head_camera/image": 0.05, "robot/chest_camera/image": 0.2}.get(key, 0.025)
        for at_s in opens_s[1:]:  # the first one is open before any source has published
            first_s, age_ms = next(d for d in deliveries if d[0] >= at_s)
            assert first_s - at_s < period_s + 0.05
            assert age_ms < 1000 * period_s + 600


def test_the_thin_link_is_not_disturbed_and_every_message_is_in_exactly_one_counter() -> None:
    beside, alone = fly(load_profile("finals-fast")), fly(None)
    assert beside["link"] == alone["link"]
    counted = ("decimated", "superseded", "expired", "overflow", "refused", "delivered", "stale", "lost")
    for key, row in beside["topics"].items():
        assert key in GOES_ROUND or row == alone["topics"][key]
        assert sum(row[name] for name in (*counted, "in_flight", "local")) == row["offered"], key
        assert all(row[name] >= 0 for name in counted), key


def test_without_a_second_link_what_goes_round_stays_on_the_robot() -> None:
    topics = fly(None, seconds=3)["topics"]
    for key in GOES_ROUND:
        assert topics[key]["delivered"] == 0
        assert topics[key]["local"] == topics[key]["offered"] > 0


def test_loss_in_the_windows_is_made_good_by_the_next_round() -> None:
    lossy = with_faults(load_profile("constant-100m-5ms"), loss_ratio=0.02)
    topics = fly(lossy, 90_000_000, seconds=4)["topics"]
    image = topics["robot/head_camera/image"]  # of 98 parts: one in seven arrives whole at once
    assert image["delivered"] > 0.1 * image["offered"]
    scan = topics["robot/lidar/scan"]
    assert scan["delivered"] > 0.7 * scan["offered"]


def test_the_same_seed_gives_the_same_bytes() -> None:
    fast = load_profile("finals-fast")
    first, again, other = (fly(fast, 5_000_000, seed=seed, seconds=3)["trace_sha256"] for seed in (3, 3, 4))
    assert first == again != other


def test_a_load_cannot_send_round_what_goes_up(tmp_path: Any) -> None:
    path = tmp_path / "load.toml"
    path.write_text('[[topics]]\nname = "a"\ndirection = "up"\nbytes = 1\nrate_hz = 1\nclass = "carousel"\n')
    with pytest.raises(ConfigError, match="expected direction down"):
        load_named_or_file(str(path))

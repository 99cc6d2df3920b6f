"""Loads and profiles from outside."""

from __future__ import annotations

from pathlib import Path

import pytest

from shaper.errors import ConfigError
from straitlink.mission import load_named_or_file
from straitlink.mission.clock import HostClock
from straitlink.mission.mission import preset_bands
from tests.mission.scenarios import band, both_ways, fly

LOAD = """
name = "mine"
[classes.video]
tier = 4
keep = "latest"
ttl_ms = 3000
[[topics]]
name = "cam"
direction = "down"
bytes = 5000
rate_hz = 4
class = "video"
[[topics]]
name = "stick"
direction = "up"
bytes = 20
rate_hz = 20
class = "command"
"""


def test_a_load_from_toml_runs(tmp_path: Path) -> None:
    path = tmp_path / "load.toml"
    path.write_text(LOAD)
    topics = fly("constant-1m-50ms", str(path), seconds=10)["topics"]
    assert topics["cam"]["delivered"] == 40
    assert topics["stick"]["delivered"] == 200
    assert topics["stick"]["direction"] == "up"


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (("bytes = 5000", "bytes = -1"), "topics[0].bytes = -1"),
        (
            ("rate_hz = 4", "rate = 4"),
            "topics[0].rate = 4: unknown key; expected one of name, direction, bytes, rate_hz, class",
        ),
        (('class = "video"', 'class = "film"'), "topics[0].class = 'film': expected one of"),
        (('name = "cam"', 'name = "cam/*"'), "without wildcards"),
        (('name = "stick"', 'name = "cam"'), "stands twice"),
        (('direction = "down"', 'direction = "left"'), 'topics[0].direction = "left"'),
    ],
)
def test_a_bad_load_is_refused_with_field_and_value(
    tmp_path: Path, change: tuple[str, str], complaint: str
) -> None:
    path = tmp_path / "load.toml"
    path.write_text(LOAD.replace(*change))
    with pytest.raises(ConfigError) as caught:
        load_named_or_file(str(path))
    assert complaint in str(caught.value)
    assert str(path) in str(caught.value)


def test_a_load_that_does_not_exist_is_refused_with_the_names_that_do() -> None:
    with pytest.raises(ConfigError, match="light, full, camera-flood"):
        load_named_or_file("heavy")


def test_blackouts_are_no_preset_band() -> None:
    profile = both_ways(
        band(1, 500_000, 80), band(1, 0, 80), band(1, 500_000, 80, loss_ratio=1.0), band(1, 90_000, 300)
    )
    assert [(b.rate_bps, b.one_way_delay_ns // 10**6) for b in preset_bands(profile, "up")] == [
        (500_000, 80),
        (90_000, 300),
    ]


@pytest.mark.parametrize("drift_ppm", [-200, 0, 37, 200])
def test_a_host_clock_converts_there_and_back(drift_ppm: int) -> None:
    clock = HostClock(offset_ns=123_456_789_012, drift_ppm=drift_ppm, unix_ns=10**18)
    for true_ns in (0, 1, 999_999_999, 1_800 * 10**9 + 7):
        local_ns = clock.local_ns(true_ns)
        assert clock.local_ns(clock.true_ns(local_ns)) >= local_ns
        assert abs(clock.true_ns(local_ns) - true_ns) <= 1
        assert clock.true_ns(local_ns + 1) >= clock.true_ns(local_ns)
        assert abs(clock.true_of_unix_ns(clock.unix_at_ns(local_ns)) - true_ns) <= 1

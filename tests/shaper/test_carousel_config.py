"""[carousel] of a configuration: what it means, and what is said of a mistake."""

from __future__ import annotations

from pathlib import Path

import pytest

from shaper.carousel import CarouselTopic
from shaper.config import ShaperConfig, load_config
from shaper.errors import ConfigError

S = 1_000_000_000
BASE = """
[link]
side = "{side}"
listen = "127.0.0.1:9001"
peer = "127.0.0.1:9002"
estimator = "adaptive"
{link}
[zenoh]
listen = ["tcp/127.0.0.1:7447"]
[[topics]]
key = "robot/heartbeat"
class = "heartbeat"
"""
ROBOT = """
[carousel]
peer = "10.0.0.2:9010"
rate_bps = 285_000_000
[[carousel.topics]]
key = "robot/camera/**"
"""


def load(
    tmp_path: Path, carousel: str, side: str = "robot", link: str = 'keys = ["link.key"]'
) -> ShaperConfig:
    path = tmp_path / "shaper.toml"
    path.write_text(BASE.format(side=side, link=link) + carousel)
    return load_config(path)


def test_a_robot_sends_at_a_fixed_rate_what_its_topics_name(tmp_path: Path) -> None:
    more = '[[carousel.topics]]\nkey = "robot/log"\nkeep = "all"\nttl_ms = 2000\nmax_hz = 4\n'
    config = load(tmp_path, ROBOT + more).carousel
    assert config is not None and config.settings is not None
    assert config.address == ("10.0.0.2", 9010)
    assert (config.settings.rate_bps, config.settings.repeat_ns) == (285_000_000, S // 2)
    assert config.settings.topics == (
        CarouselTopic("robot/camera/**", latest=True, ttl_ns=60 * S),
        CarouselTopic("robot/log", latest=False, ttl_ns=2 * S, min_period_ns=S // 4),
    )


def test_an_operator_listens(tmp_path: Path) -> None:
    config = load(tmp_path, '[carousel]\nlisten = "0.0.0.0:9010"\n', "operator").carousel
    assert config is not None
    assert (config.address, config.settings) == (("0.0.0.0", 9010), None)
    assert load(tmp_path, "", "operator").carousel is None


@pytest.mark.parametrize(
    ("side", "carousel", "words"),
    [
        ("robot", '[carousel]\nlisten = "127.0.0.1:1"\n', "carousel.listen: expected on the operator's side"),
        ("robot", '[carousel]\npeer = "10.0.0.2:1"\n', "carousel.rate_bps: is missing"),
        ("robot", ROBOT.partition("[[")[0], "carousel.topics: is missing"),
        ("operator", ROBOT, "carousel.peer: expected on the robot's side only"),
        ("operator", "[carousel]\n", "carousel.listen: is missing"),
        ("robot", ROBOT.replace("10.0.0.2:9010", "10.0.0.2"), "expected host:port"),
        ("robot", ROBOT.replace("285_000_000", "9_999"), "greater than or equal to 10000"),
        ("robot", ROBOT.replace("[[", "repeat_s = 60\n[["), "1923750000 bytes would go round: expected"),
        ("robot", ROBOT.replace("285_000_000", "20_000"), "1125 bytes would go round: expected 5888"),
        ("robot", ROBOT + 'keep = "changes"\n', "'latest' or 'all'"),
        ("robot", ROBOT + "tier = 3\n", "unknown key; expected one of key, keep, ttl_ms, max_hz"),
        ("robot", ROBOT.replace("camera/**", "camera/**x"), "carousel.topics[0].key"),
    ],
)
def test_a_mistake_is_one_sentence(tmp_path: Path, side: str, carousel: str, words: str) -> None:
    with pytest.raises(ConfigError) as raised:
        load(tmp_path, carousel, side)
    assert words in str(raised.value)
    assert str(raised.value).startswith(str(tmp_path))


def test_an_open_link_has_its_carousel_on_loopback_only(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"carousel.peer = '10.0.0.2:9010': an open link is for loopback"):
        load(tmp_path, ROBOT, link="open = true")
    assert load(tmp_path, ROBOT.replace("10.0.0.2", "127.0.0.1"), link="open = true").carousel is not None

"""The configurations that a demonstration writes for its two shapers."""

from __future__ import annotations

from pathlib import Path

import pytest
import tomlkit

from netem_scripts.profiles import load_profile
from shaper.config import ShaperConfig, load_config
from shaper.errors import ConfigError
from straitlink.demo.configs import Addresses, OwnConfigs, check_configs, write_configs
from straitlink.demo.errors import DemoError
from straitlink.demo.log_topics import LogTopic

ADDRESSES = Addresses(*(f"127.0.0.1:{port}" for port in (1, 2, 3, 4)), "tcp/127.0.0.1:5", "tcp/127.0.0.1:6")
FOREIGN = (LogTopic("/scan", "scan", 20_000, 10.0), LogTopic("/odom", "odom", 300, 50.0))
OWN = """
[link]
side = "robot"
listen = "0.0.0.0:9001"
peer = "robot.example:9101"
keys = ["fleet.key"]
journal = "kept.journal"
[zenoh]
listen = ["tcp/127.0.0.1:7447"]
[encodings.ours]
proto = "ours.proto"
[[topics]]
key = "odom"
class = "state"
max_hz = 7
encoding = "ours"
"""
PROTO = """syntax = "proto2";
import "dccl/option_extensions.proto";
message Odometry {
  option (dccl.msg) = {codec_version: 4 id: 124 max_bytes: 32 unit_system: "si"};
  required double x = 1 [(dccl.field) = {min: -100 max: 100 precision: 2}];
}
"""


def written(
    folder: Path, own: OwnConfigs, log_topics: tuple[LogTopic, ...] | None
) -> tuple[ShaperConfig, ShaperConfig]:
    """What the two shapers would read."""
    out = folder / "out"
    out.mkdir()
    check_configs(own)
    write_configs(out, ADDRESSES, load_profile("trials"), log_topics, own)
    return load_config(out / "robot.toml"), load_config(out / "operator.toml")


@pytest.fixture
def own(tmp_path: Path) -> Path:
    """A robot's configuration as somebody has it, with a schema beside it."""
    (tmp_path / "ours.proto").write_text(PROTO)
    path = tmp_path / "mine.toml"
    path.write_text(OWN)
    return path


def test_a_foreign_logs_topics_all_get_a_rule(tmp_path: Path) -> None:
    robot, _ = written(tmp_path, OwnConfigs(), FOREIGN)
    assert [(r.key_expression, r.traffic_class.name) for r in robot.endpoint.rules] == [
        ("scan", "perception"),
        ("odom", "state"),
    ]


@pytest.mark.parametrize("log_topics", [None, FOREIGN], ids=["the synthetic mission", "a foreign log"])
def test_an_own_configuration_keeps_its_rules_and_nothing_of_where_it_was(
    tmp_path: Path, own: Path, log_topics: tuple[LogTopic, ...] | None
) -> None:
    robot, operator = written(tmp_path, OwnConfigs(robot=own), log_topics)
    assert [r.key_expression for r in robot.endpoint.rules] == ["odom"]
    assert robot.endpoint.rules[0].encoding is not None, "its schema is found from another folder"
    assert robot.listen == ("127.0.0.1", 1) and robot.peer == ("127.0.0.1", 3)
    assert robot.key_files == operator.key_files == (tmp_path / "out" / "link.key",)
    assert robot.journal == tmp_path / "out" / "robot.journal"
    assert not (tmp_path / "kept.journal").exists()


def test_the_other_sides_configuration_is_refused(tmp_path: Path, own: Path) -> None:
    with pytest.raises(DemoError, match=r"mine.toml: link.side = 'robot': expected 'operator'"):
        written(tmp_path, OwnConfigs(operator=own), None)


def test_a_carousel_is_refused(tmp_path: Path, own: Path) -> None:
    document = tomlkit.parse(own.read_text())
    document["carousel"] = {"peer": "127.0.0.1:9", "rate_bps": 1_000_000, "topics": [{"key": "cloud"}]}
    own.write_text(tomlkit.dumps(document))
    with pytest.raises(DemoError, match=r"mine.toml: carousel: expected none"):
        written(tmp_path, OwnConfigs(robot=own), None)


def test_a_mistake_is_reported_as_of_the_users_file(tmp_path: Path, own: Path) -> None:
    own.write_text(OWN.replace("max_hz = 7", "max_hz = -7"))
    with pytest.raises(ConfigError, match=r"mine.toml: .*max_hz"):
        written(tmp_path, OwnConfigs(robot=own), None)

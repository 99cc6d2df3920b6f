"""A log becomes dictionaries, a table of what they gain, and a configuration that loads."""

from __future__ import annotations

import json
import random
from pathlib import Path

import pytest
from mcap.writer import Writer
from typer.testing import CliRunner

from shaper.config import load_config
from straitlink.cli import app
from straitlink.dictionaries import MAX_MESSAGES
from straitlink.replay_log import ReplayError
from tests.messages.payload.test_training import states
from tests.shaper.test_config import MINIMAL


def write_log(path: Path) -> None:
    draws = random.Random(3)
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        topics = {
            "/robot/status": states(2 * MAX_MESSAGES // 10),
            "/robot/noise": [draws.randbytes(200) for _ in range(60)],
            "/robot/camera": [draws.randbytes(120_000)] * 3,
        }
        for topic, messages in topics.items():
            channel = writer.register_channel(topic, "json", 0)
            for i, message in enumerate(messages):
                writer.add_message(channel, 1_000_000 * i, message, 1_000_000 * i)
        writer.finish()


def run(*arguments: str) -> str:
    result = CliRunner().invoke(app, ["messages", "train-dictionary", *arguments], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def test_topics_that_gain_get_a_dictionary_that_a_shaper_takes(tmp_path: Path) -> None:
    write_log(tmp_path / "log.mcap")
    text = run(str(tmp_path / "log.mcap"), "-o", str(tmp_path / "dictionaries"))
    assert [path.name for path in (tmp_path / "dictionaries").iterdir()] == ["robot.status.zdict"]
    snippet = text[text.index("[encodings") :]
    config = tmp_path / "robot.toml"
    config.write_text(MINIMAL + 'encoding = "robot_status"\n' + snippet)
    assert len(load_config(config).endpoint.encodings) == 1


def test_the_report_says_what_each_topic_gains(tmp_path: Path) -> None:
    write_log(tmp_path / "log.mcap")
    rows = {
        r["topic"]: r
        for r in json.loads(run(str(tmp_path / "log.mcap"), "-o", str(tmp_path / "d"), "--json"))
    }
    assert rows.keys() == {"robot/status", "robot/noise"}  # pictures are left out
    status, noise = rows["robot/status"], rows["robot/noise"]
    assert status["dictionary_bytes"] < 0.6 * status["zstd_bytes"] < 0.6 * status["raw_bytes"]
    assert status["gain_ratio"] > 0.4 and status["file"].endswith("robot.status.zdict")
    assert noise["file"] is None


def test_a_file_that_is_no_log_is_told(tmp_path: Path) -> None:
    (tmp_path / "x.mcap").write_bytes(b"nothing")
    with pytest.raises(ReplayError, match="not an MCAP file"):
        run(str(tmp_path / "x.mcap"))

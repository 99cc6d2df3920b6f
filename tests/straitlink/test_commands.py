"""The command line: sentences instead of tracebacks, and what needs no other process."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from straitlink.cli import app
from straitlink.errors import user_errors

PROTO = """
syntax = "proto2";
import "dccl/option_extensions.proto";
message Report {
  option (dccl.msg) = { id: 5 max_bytes: 16 codec_version: 4 };
  required double x = 1 [(dccl.field) = { min: -100 max: 100 precision: 1 }];
  optional int32 mode = 2 [(dccl.field) = { min: 0 max: 7 }];
}
"""


def run(*arguments: str) -> str:
    result = CliRunner().invoke(app, list(arguments), catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.output


def test_the_bit_budget_of_a_users_own_message_is_printed(tmp_path: Path) -> None:
    path = tmp_path / "report.proto"
    path.write_text(PROTO)
    assert json.loads(run("messages", "--proto", str(path), "--json")) == {
        "Report": {"min_bytes": 3, "max_bytes": 3}
    }
    table = run("messages", "--proto", str(path))
    assert "Report" in table and "mode" in table


def test_the_catalogue_is_printed() -> None:
    rows = json.loads(run("messages", "--json"))
    assert {row["key"] for row in rows} > {"robot/heartbeat", "operator/footstep_plan"}


def test_a_mission_s_result_is_json_on_demand() -> None:
    result = json.loads(run("mission", "--minutes", "0.1", "--load", "camera-flood", "--json"))
    assert set(result) == {"topics", "link", "trace_sha256", "wall_s"}
    assert set(result["link"]) == {"down", "up"}
    row = result["topics"]["robot/heartbeat"]
    assert {
        "direction",
        "offered",
        "delivered",
        "superseded",
        "expired",
        "lost",
        "age_p95_ms",
        "bytes",
    } <= set(row)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["mission", "--profile", "nowhere"], 'There is no link profile "nowhere"'),
        (["mission", "--load", "heavy"], "load 'heavy' is neither one of"),
        (["shaper", "/nowhere/robot.toml"], "/nowhere/robot.toml: cannot be read"),
        (["report", "/nowhere"], "/nowhere"),
        (["replay", "/nowhere.mcap", "--connect", "tcp/127.0.0.1:1"], "/nowhere.mcap"),
        (["messages", "--proto", "/nowhere.proto"], "/nowhere.proto"),
        (["replay", "/nowhere.mcap"], "give --connect or --listen"),
    ],
)
def test_a_mistake_is_an_error_of_ours_that_names_it(arguments: list[str], complaint: str) -> None:
    with pytest.raises(user_errors()) as caught:
        CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert complaint in str(caught.value)


def test_every_command_explains_itself() -> None:
    for command in app.registered_commands:
        assert command.callback is not None and command.callback.__doc__
        assert "Usage" in run(command.callback.__name__, "--help")


def test_a_shaper_whose_key_others_can_read_says_only_that(tmp_path: Path) -> None:
    config = tmp_path / "robot.toml"
    example = (Path(__file__).parents[2] / "examples" / "robot.toml").read_text()
    config.write_text(example.replace("open = true", 'keys = ["link.key"]'))
    run("keygen", str(tmp_path / "link.key"))
    (tmp_path / "link.key").chmod(0o644)
    result = CliRunner().invoke(app, ["shaper", str(config)])
    assert isinstance(result.exception, user_errors())
    assert "chmod 600" in str(result.exception) and "side on" not in result.output

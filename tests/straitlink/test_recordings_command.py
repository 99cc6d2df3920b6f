"""What `straitlink replay`, `record` and `recover` say to someone who mistypes."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from shaper.bus import BusError, BusSettings, open_bus
from straitlink.cli import app
from straitlink.recording import recover


@pytest.mark.parametrize("arguments", [["replay", "a.mcap"], ["record", "a.mcap"]])
def test_without_an_endpoint_both_options_are_named(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(BusError, match="give --connect or --listen"):
        CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert not list(tmp_path.iterdir())


def test_recover_writes_where_its_help_says(tmp_path: Path) -> None:
    cut = tmp_path / "NAME.mcap"
    cut.write_bytes(b"\x89MCAP0\r\n")
    output = CliRunner().invoke(app, ["recover", "--help"], env={"COLUMNS": "200"}).output
    assert recover(cut).name in output


@pytest.mark.parametrize(
    ("endpoint", "words"),
    [
        ("bogus/127.0.0.1:1", r"cannot open the Zenoh bus .*: Unable to connect to any of \[.*bogus.*\]$"),
        (
            "127.0.0.1:1",
            r"connect/endpoints = .* is refused: Endpoints must be of the form .*: 127\.0\.0\.1:1$",
        ),
    ],
)
def test_an_endpoint_that_cannot_be_is_told_without_zenoh_s_source_file(endpoint: str, words: str) -> None:
    with pytest.raises(BusError, match=words):
        open_bus(BusSettings(connect=[endpoint]))

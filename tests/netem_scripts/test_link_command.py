"""`straitlink link` as far as it goes without a network."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from netem_scripts.profiles import named_profiles
from straitlink.cli import app


def invoke(*arguments: str) -> tuple[int, str]:
    done = CliRunner().invoke(
        app, ["link", *arguments], env={"COLUMNS": "200", "NO_COLOR": "1", "TERM": "dumb"}
    )
    return done.exit_code, done.output


def test_the_list_has_every_profile_with_its_buffer() -> None:
    code, output = invoke("--list")
    assert code == 0
    names = [line.split()[0] for line in output.splitlines() if line.strip()]
    assert [profile.name for profile in named_profiles() if profile.name not in names] == []
    assert "4.17 s, 384,000 B" in output and "constant-<rate>[k|m]-<delay>ms" in output


def test_a_plot_is_an_svg_file(tmp_path: Path) -> None:
    path = tmp_path / "finals.svg"
    assert invoke("--profile", "finals", "--plot", str(path)) == (0, "")
    assert path.read_text().startswith("<svg ")


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--tun", "--", "true"), "give two commands: -- COMMAND_A ::: COMMAND_B"),
        (("--tun", "--", "true", ":::"), "give two commands"),
        (("--tun", "--guest", "--", "a", ":::", "b"), "only one way at a time"),
        (("--", "a", ":::", "b"), "commands run with --tun, --netem or --guest"),
        (("--tc",), "give the device to shape"),
        (("--tc", "--interface", "eth0", "--direction", "left"), "left must be down or up"),
        (("--apply",), "goes with --tc"),
        (("--netem", "--trace", "x", "--", "a", ":::", "b"), "netem keeps no trace"),
    ],
)
def test_a_call_that_makes_no_sense_is_refused(arguments: tuple[str, ...], complaint: str) -> None:
    code, output = invoke(*arguments)
    assert code == 2
    assert complaint in " ".join(output.split())


def test_tc_prints_and_touches_nothing() -> None:
    code, output = invoke("--tc", "--interface", "no-such-device", "--profile", "trials")
    assert code == 0
    assert output.count("tc qdisc") == 3

"""Virtual missions give to the last digit what was committed; who means a change runs bench.baseline --write."""

from __future__ import annotations

import json

import pytest

from bench.baseline import MISSIONS, committed, differences, measure, mission_name


def test_the_committed_figures_are_those_of_these_missions() -> None:
    assert list(committed()) == [mission_name(*mission) for mission in MISSIONS]


@pytest.mark.parametrize("mission", MISSIONS, ids=lambda mission: mission_name(*mission))
def test_a_mission_gives_what_was_committed(mission: tuple[str, str, int]) -> None:
    now = json.loads(json.dumps(measure(*mission)))
    changed = list(differences(committed()[mission_name(*mission)], now))
    assert not changed, "if this is meant: python -m bench.baseline --write, and say why in the commit"


def test_a_figure_that_changes_is_named_with_both_values() -> None:
    was, now = {"link": {"down": {"p50_ms": 1.5}}}, {"link": {"down": {"p50_ms": 1.6}}}
    assert list(differences(was, now)) == ["link.down.p50_ms: 1.5 became 1.6"]

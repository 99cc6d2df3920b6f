"""With falls at regular times the link's queue stays empty through them; irregular links are left alone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from netem_scripts.band import Profile
from shaper.estimation.regular_falls import NEEDED
from straitlink.mission import run_mission
from straitlink.mission.mission import adaptive, predicting
from tests.mission.scenarios import TraceLog, band, both_ways, settings

S = 1_000_000_000
FAST, THIN = (6, 500_000, 50), (5, 50_000, 300)


def fly(
    profile: Profile, estimator: Any, seconds: float, falls_s: list[float]
) -> dict[str, tuple[float, list[float]]]:
    """By direction: the use of the link, and the longest queue (s) that packets met after each fall."""
    trace = TraceLog()
    result = run_mission(replace(settings(profile, "backlogged", seconds, 1), estimator=estimator), trace)
    flown = {}
    for way in ("down", "up"):
        packets = [
            (int(str(r["t_ns"])) / S, int(str(r["queue_delay_ns"])) / S)
            for r in trace.records["link"]
            if r["event"] == "packet" and r["direction"] == way
        ]
        peaks_s = [max(q for t, q in packets if at_s - 1 <= t < at_s + 4) for at_s in falls_s]
        flown[way] = result["link"][way]["utilisation"], peaks_s
    return flown


def test_after_three_cycles_a_regular_fall_finds_the_link_empty() -> None:
    profile, falls_s = both_ways(band(*FAST), band(*THIN), cyclic=True), [6.0, 17.0, 28.0, 39.0]
    foreseen, surprised = (fly(profile, each, 44, falls_s) for each in (predicting, adaptive))
    for way in ("down", "up"):
        (use, peaks_s), (other_use, other_peaks_s) = foreseen[way], surprised[way]
        assert peaks_s[:NEEDED] == pytest.approx(other_peaks_s[:NEEDED], abs=0.2)  # nothing is known yet
        assert peaks_s[NEEDED] < 0.2 < 0.4 < other_peaks_s[NEEDED]
        assert use > other_use - 0.02


def test_on_a_link_that_is_not_regular_nothing_changes() -> None:
    falls_s, at_s, bands = [], 0.0, []
    for index, seconds in enumerate((5, 3, 8, 4, 6, 3, 4, 5)):
        fast, (_, rate_bps, delay_ms) = index % 2 == 0, (FAST, THIN)[index % 2]
        bands.append(band(seconds, rate_bps, delay_ms))
        falls_s += [] if fast else [at_s]
        at_s += seconds
    profile = both_ways(*bands)
    foreseen, control = (fly(profile, each, at_s, falls_s) for each in (predicting, adaptive))
    assert foreseen == control

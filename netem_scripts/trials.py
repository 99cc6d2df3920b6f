"""The DARPA Robotics Challenge Trials of December 2013, and links made of them with one thing changed.

As Team MIT's paper reports them: 1 Mbit/s with 50 ms and 100 kbit/s with 500 ms, one way, changing over each
minute, from a Mini-Maxwell box (netem) that buffered up to 10 s, which is how MIT's queue grew. Their
shaper's configuration agrees: latency [50, 500] ms, throughput [950000, 95000] bit/s (95 %), fallback after
50 s of the fast band.
"""

from __future__ import annotations

from dataclasses import replace

from .band import Band, DirectionProfile, Profile

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000

TRIALS_FAST_BPS, TRIALS_FAST_DELAY_NS = 1_000_000, 50 * NS_PER_MS
TRIALS_SLOW_BPS, TRIALS_SLOW_DELAY_NS = 100_000, 500 * NS_PER_MS
TRIALS_BAND_NS = 60 * NS_PER_S
TRIALS_BUFFER_NS = 10 * NS_PER_S


def trials() -> Profile:
    """The Trials as announced: fast and near, slow and far, a minute each, fast first."""
    return _alternating(
        "trials",
        Band(TRIALS_BAND_NS, TRIALS_FAST_BPS, TRIALS_FAST_DELAY_NS),
        Band(TRIALS_BAND_NS, TRIALS_SLOW_BPS, TRIALS_SLOW_DELAY_NS),
        description="1 Mbit/s with 50 ms, 100 kbit/s with 500 ms, 60 s each, both directions together",
        source="DRC Trials 2013, Team MIT's paper and shaper configuration",
    )


def trials_swapped() -> Profile:
    """The Trials with the delays exchanged: what filled 10 s of buffer unseen by a shaper of presets."""
    return _alternating(
        "trials-swapped",
        Band(TRIALS_BAND_NS, TRIALS_FAST_BPS, TRIALS_SLOW_DELAY_NS),
        Band(TRIALS_BAND_NS, TRIALS_SLOW_BPS, TRIALS_FAST_DELAY_NS),
        description="1 Mbit/s with 500 ms, 100 kbit/s with 50 ms, 60 s each, both directions together",
        source="DRC Trials 2013, the settings as they were swapped there; same figures otherwise",
    )


def trials_small_buffer() -> Profile:
    """The Trials behind 100 ms of buffer: overshoot is lost at once instead of queued."""
    profile = trials()
    direction = replace(profile.down, buffer_ns=100 * NS_PER_MS)
    return Profile(
        "trials-small-buffer",
        direction,
        direction,
        f"{profile.description}; 100 ms of buffer",
        "the Trials' bands; the buffer is ours",
    )


def lossy_10() -> Profile:
    """The Trials with every tenth packet lost, one by one: loss that is no congestion."""
    return _lossy("lossy-10", 0.10)


def lossy_20() -> Profile:
    """The Trials with every fifth packet lost, one by one."""
    return _lossy("lossy-20", 0.20)


def asymmetric() -> Profile:
    """The Trials with a fifth and a half of the rate on the way up."""
    bands = (
        Band(TRIALS_BAND_NS, 200_000, TRIALS_FAST_DELAY_NS),
        Band(TRIALS_BAND_NS, 50_000, TRIALS_SLOW_DELAY_NS),
    )
    down = trials().down
    return Profile(
        "asymmetric",
        down,
        replace(down, bands=bands),
        "down as trials; up 200 kbit/s with 50 ms, 50 kbit/s with 500 ms, 60 s each",
        "the Trials' bands; the rates up are ours",
    )


def _lossy(name: str, loss_ratio: float) -> Profile:
    profile = trials()
    bands = tuple(replace(band, loss_ratio=loss_ratio) for band in profile.down.bands)
    direction = replace(profile.down, bands=bands)
    return Profile(
        name,
        direction,
        direction,
        f"{profile.description}; {loss_ratio:.0%} independent loss",
        "the Trials' bands; the loss is ours",
    )


def _alternating(name: str, first: Band, second: Band, *, description: str, source: str) -> Profile:
    direction = DirectionProfile((first, second), cyclic=True, buffer_ns=TRIALS_BUFFER_NS)
    return Profile(name, direction, direction, description, source)

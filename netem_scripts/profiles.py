"""The links that have a name, each number with its source; any other comes from a file."""

from __future__ import annotations

import re
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path

from .band import Band, DirectionProfile, Profile, ProfileError
from .profile_file import read_profile

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000

# DARPA Robotics Challenge Trials, December 2013, as Team MIT's paper reports it: 1 Mbit/s with 50 ms and
# 100 kbit/s with 500 ms, one way, changing over each minute. Their shaper's configuration agrees:
# latency [50, 500] ms, throughput [950000, 95000] bit/s (95 %), fallback after 50 s of the fast band.
TRIALS_FAST_BPS, TRIALS_FAST_DELAY_NS = 1_000_000, 50 * NS_PER_MS
TRIALS_SLOW_BPS, TRIALS_SLOW_DELAY_NS = 100_000, 500 * NS_PER_MS
TRIALS_BAND_NS = 60 * NS_PER_S
TRIALS_BUFFER_NS = (
    10 * NS_PER_S
)  # same paper: the emulator buffered up to 10 s, which is how MIT's queue grew

_CONSTANT = re.compile(r"constant-(\d+(?:\.\d+)?)([km]?)-(\d+(?:\.\d+)?)ms")
_BPS_PER_UNIT = {"": 1, "k": 1_000, "m": 1_000_000}
_CONSTANT_FORM = "constant-<rate>[k|m]-<delay>ms"


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


def constant(
    rate_bps: int,
    one_way_delay_ns: int,
    *,
    loss_ratio: float = 0.0,
    jitter_ns: int = 0,
    buffer_ns: int | None = TRIALS_BUFFER_NS,
    name: str = "constant",
) -> Profile:
    """One band for ever, the same in both directions; the buffer is that of the Trials unless given."""
    band = Band(TRIALS_BAND_NS, rate_bps, one_way_delay_ns, loss_ratio=loss_ratio, jitter_ns=jitter_ns)
    direction = DirectionProfile((band,), buffer_ns=buffer_ns)
    description = f"{rate_bps / 1000:g} kbit/s with {one_way_delay_ns / NS_PER_MS:g} ms for ever"
    return Profile(name, direction, direction, description, "parameters")


_NAMED: dict[str, Callable[[], Profile]] = {"trials": trials, "trials-swapped": trials_swapped}


def profile_names() -> tuple[str, ...]:
    """The names that profile_named knows, the constant family as its form."""
    return (*_NAMED, _CONSTANT_FORM)


def profile_named(name: str) -> Profile:
    """A profile by name: one of the table, or "constant-100k-500ms", "constant-1m-50ms", and so on.

    Raises ProfileError, which lists what exists.
    """
    if name in _NAMED:
        return _NAMED[name]()
    if match := _CONSTANT.fullmatch(name):
        rate, unit, delay_ms = match.groups()
        rate_bps = int(Decimal(rate) * _BPS_PER_UNIT[unit])
        return constant(rate_bps, int(Decimal(delay_ms) * NS_PER_MS), name=name)
    raise ProfileError(f'There is no link profile "{name}"; there are {", ".join(profile_names())}.')


def load_profile(path_or_name: str | Path) -> Profile:
    """A profile by name, or from a TOML file (anything that ends in .toml or has a slash).

    Raises ProfileError.
    """
    text = str(path_or_name)
    if isinstance(path_or_name, Path) or text.endswith(".toml") or "/" in text:
        return read_profile(Path(path_or_name))
    return profile_named(text)


def _alternating(name: str, first: Band, second: Band, *, description: str, source: str) -> Profile:
    direction = DirectionProfile((first, second), cyclic=True, buffer_ns=TRIALS_BUFFER_NS)
    return Profile(name, direction, direction, description, source)

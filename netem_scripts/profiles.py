"""The links that have a name, each number with its source; any other comes from a file."""

from __future__ import annotations

import re
from collections.abc import Callable
from decimal import Decimal
from pathlib import Path

from . import field_links, finals, trials
from .band import Band, DirectionProfile, Profile, ProfileError
from .profile_csv import read_csv_profile
from .profile_file import read_profile
from .trials import TRIALS_BAND_NS, TRIALS_BUFFER_NS

NS_PER_MS = 1_000_000

_NUMBER = r"(\d+(?:\.\d+)?)"
_CONSTANT = re.compile(
    rf"constant-{_NUMBER}([km]?)-{_NUMBER}ms(?:-loss{_NUMBER})?(?:-jitter{_NUMBER}ms)?(?:-buffer{_NUMBER}ms)?"
)
_FINALS = re.compile(r"finals-(fast-)?(\d+)")
_BPS_PER_UNIT = {"": 1, "k": 1_000, "m": 1_000_000}
CONSTANT_FORM = "constant-<rate>[k|m]-<delay>ms[-loss<percent>][-jitter<ms>ms][-buffer<ms>ms]"


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
    if loss_ratio:
        description += f", loss {loss_ratio:.3g}"
    if jitter_ns:
        description += f", jitter {jitter_ns / NS_PER_MS:g} ms"
    return Profile(name, direction, direction, description, "parameters")


_NAMED: dict[str, Callable[[], Profile]] = {
    "trials": trials.trials,
    "trials-swapped": trials.trials_swapped,
    "trials-small-buffer": trials.trials_small_buffer,
    "lossy-10": trials.lossy_10,
    "lossy-20": trials.lossy_20,
    "asymmetric": trials.asymmetric,
    "finals": finals.finals,
    "finals-slow": finals.finals_slow,
    "finals-fast": finals.finals_fast,
    "blackouts": field_links.blackouts,
    "blackouts-hold": field_links.blackouts_hold,
    "satellite": field_links.satellite,
    "lte-walk": field_links.lte_walk,
    "hard-random": field_links.hard_random,
}


def profile_names() -> tuple[str, ...]:
    """The names that profile_named knows, the constant family as its form."""
    return (*_NAMED, CONSTANT_FORM)


def named_profiles() -> tuple[Profile, ...]:
    """All profiles of the table, in its order."""
    return tuple(make() for make in _NAMED.values())


def profile_named(name: str) -> Profile:
    """A profile by name: one of the table, "constant-100k-500ms" and so on, "finals-<seed>"
    or "finals-fast-<seed>".

    Raises ProfileError, which lists what exists.
    """
    if name in _NAMED:
        return _NAMED[name]()
    if match := _FINALS.fullmatch(name):
        return (finals.finals_fast if match[1] else finals.finals)(int(match[2]))
    if match := _CONSTANT.fullmatch(name):
        rate, unit, delay_ms, loss_percent, jitter_ms, buffer_ms = match.groups()
        return constant(
            int(Decimal(rate) * _BPS_PER_UNIT[unit]),
            _ns(delay_ms),
            loss_ratio=float(Decimal(loss_percent or 0) / 100),
            jitter_ns=_ns(jitter_ms or "0"),
            buffer_ns=TRIALS_BUFFER_NS if buffer_ms is None else _ns(buffer_ms),
            name=name,
        )
    raise ProfileError(f'There is no link profile "{name}"; there are {", ".join(profile_names())}.')


def load_profile(path_or_name: str | Path) -> Profile:
    """A profile by name, or from a file: TOML, or CSV where its name ends in .csv.

    A file is what ends in .toml or .csv, or has a slash. Raises ProfileError.
    """
    text = str(path_or_name)
    if text.endswith(".csv"):
        return read_csv_profile(Path(path_or_name))
    if isinstance(path_or_name, Path) or text.endswith(".toml") or "/" in text:
        return read_profile(Path(path_or_name))
    return profile_named(text)


def _ns(milliseconds: str) -> int:
    return int(Decimal(milliseconds) * NS_PER_MS)

"""Missions as data, and what one asks of their results."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from netem_scripts.band import Band, DirectionProfile, Profile
from netem_scripts.profiles import load_profile
from shaper.trace_records import Record
from straitlink.mission import MissionSettings, load_named_or_file, run_mission

S = 1_000_000_000
MS = 1_000_000


def both_ways(*bands: Band, cyclic: bool = False, buffer_s: int = 10) -> Profile:
    """The same bands in both directions."""
    direction = DirectionProfile(bands, cyclic=cyclic, buffer_ns=buffer_s * S)
    return Profile("scenario", direction, direction)


def band(seconds: float, rate_bps: int, delay_ms: int, **faults: Any) -> Band:
    return Band(int(seconds * S), rate_bps, delay_ms * MS, **faults)


def fly(
    profile: str | Profile, load: str = "camera-flood", seconds: float = 60, seed: int = 1
) -> dict[str, Any]:
    """Run a mission; the result is what `straitlink mission --json` prints."""
    return run_mission(settings(profile, load, seconds, seed))


def settings(profile: str | Profile, load: str, seconds: float, seed: int) -> MissionSettings:
    found = profile if isinstance(profile, Profile) else load_profile(profile)
    return MissionSettings(found, load_named_or_file(load), int(seconds * S), seed)


def with_faults(profile: Profile, **faults: Any) -> Profile:
    """The profile with loss, jitter, duplication or reordering in every band."""

    def worse(direction: DirectionProfile) -> DirectionProfile:
        return replace(direction, bands=tuple(replace(b, **faults) for b in direction.bands))

    return replace(profile, down=worse(profile.down), up=worse(profile.up))


class TraceLog:
    """Keeps the records of a mission in memory."""

    def __init__(self) -> None:
        self.records: dict[str, list[Record]] = {"robot": [], "operator": [], "link": []}

    def __call__(self, name: str, record: Record) -> None:
        self.records[name].append(record)

    def deliveries(self, side: str, topic: str) -> list[tuple[float, float]]:
        """(when in s, age in ms) of each delivery of a topic at a side, as that side measured it.

        The first ones, before a round trip has told the clocks apart, have no age and are left out.
        """
        return [
            (float(r["t_ns"]) / S, float(r["age_ns"]) / MS)  # type: ignore[arg-type]
            for r in self.records[side]
            if r["event"] == "delivered" and r["topic"] == topic and r["age_ns"] is not None
        ]

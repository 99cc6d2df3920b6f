"""What of the adaptive estimator can be switched off, to see what it is worth (bench.link_estimation)."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Ideas:
    """All of them by default."""

    silence: bool = True
    overdue: bool = True
    way_back: bool = True
    quickened: bool = True
    verify: bool = True
    gaps: bool = True
    anchor: bool = True
    quicker: bool = True
    bands: bool = True
    unchanged: bool = True
    remainder: bool = True
    standstill: bool = True

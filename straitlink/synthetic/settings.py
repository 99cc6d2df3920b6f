"""What to synthesise, and what came of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Texture = Literal["busy", "indoor"]
TEXTURES: tuple[Texture, ...] = ("busy", "indoor")

# Every log starts at this instant, 2026-01-01 00:00:00 UTC, so that equal settings give equal bytes.
START_NS = 1_767_225_600 * 1_000_000_000
LIGHT_MAX_RATE_HZ = 50.0


@dataclass(frozen=True, slots=True)
class SyntheticSettings:
    """The arguments of a synthetic mission; equal settings give byte-identical logs.

    duration_s: length of the log; samples lie in [0, duration_s).
    seed: 0..2^63-1; moves the blocks, the noise and the operator's script.
    light: for tests: every topic at 50 Hz or less, 271 beams, head camera 320x170.
    texture: "busy" costs about as many JPEG bytes per pixel as an outdoor scene, "indoor" half of that.
    """

    duration_s: float = 60.0
    seed: int = 1
    light: bool = False
    texture: Texture = "busy"

    def __post_init__(self) -> None:
        if not 0 < self.duration_s <= 86_400:
            raise ValueError(f"duration_s = {self.duration_s}: must be above 0 and at most 86400")
        if not 0 <= self.seed < 2**63:
            raise ValueError(f"seed = {self.seed}: must be in 0..2^63-1")
        if self.texture not in TEXTURES:
            raise ValueError(f"texture = {self.texture!r}: must be one of {', '.join(TEXTURES)}")

    @property
    def duration_ns(self) -> int:
        """The length of the log in nanoseconds."""
        return round(self.duration_s * 1e9)


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """What one topic came to.

    payload_bytes: sum over its messages, without MCAP's or Zenoh's own overhead.
    """

    key: str
    schema_name: str
    messages: int
    payload_bytes: int


@dataclass(frozen=True, slots=True)
class SyntheticSummary:
    """What was written: totals over all topics, then each topic in the catalogue's order."""

    path: Path
    duration_s: float
    messages: int
    payload_bytes: int
    file_bytes: int
    topics: tuple[TopicSummary, ...]

    @property
    def messages_per_s(self) -> float:
        """Mean over the log, both directions."""
        return self.messages / self.duration_s

    @property
    def payload_bytes_per_s(self) -> float:
        """Mean over the log, both directions."""
        return self.payload_bytes / self.duration_s

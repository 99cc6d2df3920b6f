"""What a link is made of: bands, one direction's schedule of bands, and both directions together."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

IP_UDP_HEADER_BYTES = 28  # IPv4 20 (RFC 791 section 3.1) + UDP 8 (RFC 768)


class ProfileError(Exception):
    """A profile does not exist or makes no sense; the message names field, value and bound."""


class JitterShape(StrEnum):
    """How the extra delay of a packet is drawn."""

    HALF_NORMAL = "half-normal"
    """|N(0, jitter_ns)|: mean 0.80 jitter_ns, p95 1.96 jitter_ns."""
    UNIFORM = "uniform"
    """Evenly from 0 to jitter_ns."""


@dataclass(frozen=True, slots=True)
class Band:
    """The state of one direction for a while.

    rate_bps: what the link serves, headers included; 0 is a blackout that holds the queue.
    one_way_delay_ns: propagation, added behind the queue to what leaves it during the band.
    loss_ratio: of what leaves the queue, 0..1; 1.0 is a blackout that drops.
    jitter_ns: scale of an extra delay, drawn per packet as jitter_shape says.
    duplicate_ratio: of what is not lost, 0..1; the copy takes no capacity, as it is made at the far end.
    reorder: a packet may overtake earlier ones; otherwise it waits for them.
    """

    duration_ns: int
    rate_bps: int
    one_way_delay_ns: int
    loss_ratio: float = 0.0
    jitter_ns: int = 0
    jitter_shape: JitterShape = JitterShape.HALF_NORMAL
    duplicate_ratio: float = 0.0
    reorder: bool = False

    def __post_init__(self) -> None:
        if self.duration_ns <= 0:
            raise ProfileError(f"A band's duration_ns = {self.duration_ns} must be greater than 0.")
        for name in ("rate_bps", "one_way_delay_ns", "jitter_ns"):
            if getattr(self, name) < 0:
                raise ProfileError(f"A band's {name} = {getattr(self, name)} must be at least 0.")
        for name in ("loss_ratio", "duplicate_ratio"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ProfileError(f"A band's {name} = {getattr(self, name)} must be between 0 and 1.")

    @property
    def is_ideal(self) -> bool:
        """Nothing happens behind the queue but the delay, so no random number is drawn."""
        return not (self.loss_ratio or self.jitter_ns or self.duplicate_ratio or self.reorder)


@dataclass(frozen=True, slots=True)
class DirectionProfile:
    """One direction of a link: its bands in order, and the buffer in front of them.

    cyclic: after the last band comes the first again; otherwise the last band lasts for ever.
    buffer_ns: limit on the time to drain what is queued, at the rate of the moment; None is no limit.
    buffer_bytes: limit on what is queued, headers included; None is no limit. The stricter one holds.
    overhead_bytes: added to each payload: what IP and UDP cost on the wire.
    """

    bands: tuple[Band, ...]
    cyclic: bool = False
    buffer_ns: int | None = None
    buffer_bytes: int | None = None
    overhead_bytes: int = IP_UDP_HEADER_BYTES

    def __post_init__(self) -> None:
        if not self.bands:
            raise ProfileError("A direction's bands = () must hold at least one band.")
        serving = self.bands if self.cyclic else self.bands[-1:]
        if not any(band.rate_bps for band in serving):
            where = "every band" if self.cyclic else "the last band"
            raise ProfileError(
                f"A direction's rate_bps = 0 in {where} would hold its queue for ever; it must be greater "
                "than 0 (for a link that is cut, set loss_ratio = 1)."
            )
        for name in ("buffer_ns", "buffer_bytes"):
            limit = getattr(self, name)
            if limit is not None and limit <= 0:
                raise ProfileError(f"A direction's {name} = {limit} must be greater than 0, or None.")
        if self.overhead_bytes < 0:
            raise ProfileError(f"A direction's overhead_bytes = {self.overhead_bytes} must be at least 0.")


@dataclass(frozen=True, slots=True)
class Profile:
    """A link with a name. down: robot to operator; up: operator to robot."""

    name: str
    down: DirectionProfile
    up: DirectionProfile
    description: str = ""
    source: str = ""

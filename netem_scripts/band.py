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


class Order(StrEnum):
    """What a packet meets first."""

    RATE_THEN_DELAY = "rate-then-delay"
    """The buffer and the server, then the delay line: a thin link whose far end is far away."""
    DELAY_THEN_RATE = "delay-then-rate"
    """Chance and the delay line, then the buffer and the server: as one netem qdisc does it."""


@dataclass(frozen=True, slots=True)
class BurstLoss:
    """Loss in bursts: a good and a bad state, changed per packet (Gilbert 1960, Elliott 1963).

    enter_bad_ratio, leave_bad_ratio: chance per packet to go from good to bad and back; netem's p and r.
    A mean burst of the bad state has 1 / leave_bad_ratio packets.
    bad_loss_ratio, good_loss_ratio: loss in each state; netem's 1-h and 1-k.
    """

    enter_bad_ratio: float
    leave_bad_ratio: float
    bad_loss_ratio: float = 1.0
    good_loss_ratio: float = 0.0

    def __post_init__(self) -> None:
        for name in ("enter_bad_ratio", "leave_bad_ratio"):
            if not 0.0 < getattr(self, name) <= 1.0:
                value = getattr(self, name)
                raise ProfileError(f"A burst loss's {name} = {value} must be above 0 and at most 1.")
        for name in ("bad_loss_ratio", "good_loss_ratio"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ProfileError(f"A burst loss's {name} = {getattr(self, name)} must be between 0 and 1.")

    @property
    def mean_ratio(self) -> float:
        """The loss in the long run."""
        bad = self.enter_bad_ratio / (self.enter_bad_ratio + self.leave_bad_ratio)
        return bad * self.bad_loss_ratio + (1 - bad) * self.good_loss_ratio


@dataclass(frozen=True, slots=True)
class Band:
    """The state of one direction for a while.

    rate_bps: what the link serves, headers included; 0 is a blackout that holds the queue.
    one_way_delay_ns: propagation, added behind the queue to what leaves it during the band; in the order
        delay-then-rate, before the queue to what enters the link during the band.
    loss_ratio: of what leaves the queue, 0..1; 1.0 is a blackout that drops. In the order delay-then-rate, of
        what enters the link.
    burst_loss: loss in bursts instead; its state lasts from band to band.
    jitter_ns: scale of an extra delay, drawn per packet as jitter_shape says.
    duplicate_ratio: of what is not lost, 0..1; the copy takes no capacity, as it is made at the far end.
        In the order delay-then-rate the copy is made before the queue and takes capacity.
    corrupt_ratio: of what is not lost, 0..1; one bit of the payload is flipped.
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
    corrupt_ratio: float = 0.0
    burst_loss: BurstLoss | None = None

    def __post_init__(self) -> None:
        if self.duration_ns <= 0:
            raise ProfileError(f"A band's duration_ns = {self.duration_ns} must be greater than 0.")
        for name in ("rate_bps", "one_way_delay_ns", "jitter_ns"):
            if getattr(self, name) < 0:
                raise ProfileError(f"A band's {name} = {getattr(self, name)} must be at least 0.")
        for name in ("loss_ratio", "duplicate_ratio", "corrupt_ratio"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ProfileError(f"A band's {name} = {getattr(self, name)} must be between 0 and 1.")
        if self.loss_ratio and self.burst_loss is not None:
            raise ProfileError(
                f"A band's loss_ratio = {self.loss_ratio} must be 0 where it has a burst_loss."
            )

    @property
    def is_ideal(self) -> bool:
        """Nothing happens behind the queue but the delay, so no random number is drawn."""
        return not (
            self.loss_ratio
            or self.burst_loss
            or self.jitter_ns
            or self.duplicate_ratio
            or self.corrupt_ratio
            or self.reorder
        )

    @property
    def mean_loss_ratio(self) -> float:
        """The loss in the long run, whichever way it is drawn."""
        return self.loss_ratio if self.burst_loss is None else self.burst_loss.mean_ratio


@dataclass(frozen=True, slots=True)
class DirectionProfile:
    """One direction of a link: its bands in order, and the buffer in front of them.

    cyclic: after the last band comes the first again; otherwise the last band lasts for ever.
    buffer_ns: limit on the time to drain what is queued, at the rate of the moment; None is no limit.
    buffer_bytes: limit on what is queued, headers included; None is no limit.
    buffer_packets: limit on the packets queued, the one in service included; None is no limit. The
        strictest of the three holds.
    overhead_bytes: added to each payload: what IP and UDP cost on the wire.
    minimum_bytes: a packet that is smaller on the wire costs so much.
    mtu_bytes: a packet that is larger on the wire is dropped at its entry; None is no limit.
    """

    bands: tuple[Band, ...]
    cyclic: bool = False
    buffer_ns: int | None = None
    buffer_bytes: int | None = None
    overhead_bytes: int = IP_UDP_HEADER_BYTES
    buffer_packets: int | None = None
    minimum_bytes: int = 0
    mtu_bytes: int | None = None
    order: Order = Order.RATE_THEN_DELAY

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
        for name in ("buffer_ns", "buffer_bytes", "buffer_packets", "mtu_bytes"):
            limit = getattr(self, name)
            if limit is not None and limit <= 0:
                raise ProfileError(f"A direction's {name} = {limit} must be greater than 0, or None.")
        for name in ("overhead_bytes", "minimum_bytes"):
            if getattr(self, name) < 0:
                raise ProfileError(f"A direction's {name} = {getattr(self, name)} must be at least 0.")


@dataclass(frozen=True, slots=True)
class Profile:
    """A link with a name. down: robot to operator; up: operator to robot."""

    name: str
    down: DirectionProfile
    up: DirectionProfile
    description: str = ""
    source: str = ""

"""What goes wrong in a chaos mission, drawn from its seed."""

from __future__ import annotations

import random
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from netem_scripts.band import Band, DirectionProfile

NS_PER_S = 1_000_000_000
STORM_NS = 40 * NS_PER_S
CALM_NS = 24 * NS_PER_S  # after it: whatever was under way has an outcome, whoever was lost is found
CLOCK_STEP_NS = 3600 * NS_PER_S
_MTUS_BYTES = (1500, 1500, 1280, 900, 620)  # IP packets
_MEAN_NS_BETWEEN_FAULTS = 2 * NS_PER_S
_BAND_NS = (NS_PER_S, 8 * NS_PER_S)


class FaultKind(StrEnum):
    """What happens to one side."""

    KILL = "kill"  # kill -9, and a new process at once or after a while
    MOVE = "move"  # its address changes, as behind a NAT
    CLOCK = "clock"  # its wall clock is stepped by an hour
    MTU = "mtu"  # large packets vanish in both directions from now on
    HOSTILE = "hostile"  # somebody repeats, cuts, alters and invents datagrams
    RELAY = "relay"  # somebody is faster than the link, and passes all on from an address of his own


Side = Literal["robot", "operator"]


@dataclass(frozen=True, slots=True)
class Fault:
    """One thing that goes wrong. amount: seconds, bytes or a seed, as the kind has it."""

    at_ns: int
    kind: FaultKind
    side: Side
    amount: int


def draw_faults(rng: random.Random) -> list[Fault]:
    """The faults of a mission in order; with the last one the storm is over."""
    faults: list[Fault] = []
    at_ns = 0
    while (at_ns := at_ns + round(rng.expovariate(1 / _MEAN_NS_BETWEEN_FAULTS))) < STORM_NS:
        kind = rng.choices(list(FaultKind), weights=(5, 2, 1, 1, 3, 1))[0]
        side: Side = "operator" if rng.random() < 0.5 and kind is not FaultKind.MOVE else "robot"
        if kind is FaultKind.MTU:
            amount = rng.choice(_MTUS_BYTES)
        elif kind is FaultKind.KILL:
            amount = rng.choice((0, 0, 1, 100, 3000))  # milliseconds until the next process
        else:
            amount = rng.getrandbits(32)
        faults.append(Fault(at_ns, kind, side, amount))
    faults.append(Fault(STORM_NS, FaultKind.MTU, "robot", 1500))
    return faults


def draw_direction(rng: random.Random) -> DirectionProfile:
    """One direction's bands while the storm lasts, and a plain one after it."""
    bands = []
    left_ns = STORM_NS
    while left_ns > 0:
        duration_ns = min(left_ns, rng.randint(*_BAND_NS))
        bands.append(_draw_band(rng, duration_ns))
        left_ns -= duration_ns
    bands.append(Band(CALM_NS, 1_000_000, 30_000_000))
    return DirectionProfile(tuple(bands), buffer_ns=10 * NS_PER_S)


def _draw_band(rng: random.Random, duration_ns: int) -> Band:
    dark = rng.random()
    if dark < 0.1:
        return Band(duration_ns, 1_000_000, 50_000_000, loss_ratio=1.0)
    if dark < 0.15:
        return Band(duration_ns, 0, 50_000_000)  # a blackout that holds the queue
    chance = rng.random
    return Band(
        duration_ns,
        rng.choice((100_000, 300_000, 1_000_000, 10_000_000)),
        rng.choice((1, 20, 50, 200, 500)) * 1_000_000,
        loss_ratio=rng.choice((0.0, 0.02, 0.1, 0.3)),
        jitter_ns=rng.choice((0, 0, 5, 50)) * 1_000_000,
        duplicate_ratio=0.1 if chance() < 0.3 else 0.0,
        corrupt_ratio=0.1 if chance() < 0.3 else 0.0,
        reorder=chance() < 0.3,
    )

"""The links of the estimator's table: the named profiles, and those with one thing changed."""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import dataclass, replace

from netem_scripts.band import Band, DirectionProfile, Profile
from netem_scripts.profiles import constant, load_profile
from netem_scripts.trials import TRIALS_BUFFER_NS, trials

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000
RANDOM_DURATION_S = 360


@dataclass(frozen=True, slots=True)
class Row:
    """A line of the table. make: the link by seed. Targets are of issue 10; None where it has none."""

    make: Callable[[int], Profile]
    utilisation: float
    p50_ms: float | None = None
    p95_ms: float | None = None
    long_ratio: float | None = None
    down_s: float | None = None
    up_s: float | None = None
    drift_ppm: int = 50


def _named(name: str) -> Callable[[int], Profile]:
    return lambda _: load_profile(name)


def _jitter(milliseconds: int) -> Callable[[int], Profile]:
    def make(_: int) -> Profile:
        profile = trials()
        bands = tuple(replace(b, jitter_ns=milliseconds * NS_PER_MS) for b in profile.down.bands)
        direction = replace(profile.down, bands=bands)
        return replace(profile, name=f"jitter-{milliseconds}", down=direction, up=direction)

    return make


def _one_way_only(changing: str) -> Callable[[int], Profile]:
    def make(_: int) -> Profile:
        profile = trials()
        steady = replace(profile.down, bands=profile.down.bands[:1])
        if changing == "down":
            return replace(profile, name="down-only", up=steady)
        return replace(profile, name="up-only", down=steady)

    return make


def _blackouts(rate_bps: int, delay_ms: int, *, holds: bool) -> Callable[[int], Profile]:
    def make(seed: int) -> Profile:
        rng = random.Random(f"blackouts {seed}")
        bands = []
        for dark_s in rng.sample((1.0, 2.0, 3.0, 5.0, 10.0, 30.0), 6):
            lit = Band(round(rng.uniform(15, 25) * NS_PER_S), rate_bps, delay_ms * NS_PER_MS)
            dark = (
                replace(lit, duration_ns=round(dark_s * NS_PER_S), rate_bps=0)
                if holds
                else replace(lit, duration_ns=round(dark_s * NS_PER_S), loss_ratio=1.0)
            )
            bands += [lit, dark]
        direction = DirectionProfile(tuple(bands), cyclic=True, buffer_ns=TRIALS_BUFFER_NS)
        return Profile("blackouts", direction, direction)

    return make


def random_profile(seed: int, *, loss_ratio: float = 0.05, jitter_ms: float = 0.0) -> Profile:
    """50 kbit/s to 3 Mbit/s (log-uniform), 10 to 600 ms, 10 to 40 s each; both directions change together."""
    rng = random.Random(f"random bands {seed}")
    down, up = [], []
    for _ in range(24):
        dwell_ns = round(rng.uniform(10, 40) * NS_PER_S)
        for bands in (down, up):
            bands.append(
                Band(
                    dwell_ns,
                    round(50_000 * 60 ** rng.random()),
                    round(rng.uniform(10, 600) * NS_PER_MS),
                    loss_ratio=loss_ratio,
                    jitter_ns=round(jitter_ms * NS_PER_MS),
                )
            )
    return Profile(
        f"random-{seed}",
        *(DirectionProfile(tuple(bands), cyclic=True, buffer_ns=TRIALS_BUFFER_NS) for bands in (down, up)),
    )


def _random_alike(seed: int) -> Profile:
    """The same bands both ways, as most links have them."""
    profile = random_profile(seed)
    return replace(profile, name=f"random-alike-{seed}", up=profile.down)


ROWS: dict[str, Row] = {
    "trials": Row(_named("trials"), 0.96, 20, 65, 0.01, 0.12, 0.8),
    "trials-swapped": Row(_named("trials-swapped"), 0.95, 20, 350, 0.07, 0.65, 1.3),
    "trials-small-buffer": Row(_named("trials-small-buffer"), 0.96, 20, 65, 0.005),
    "asymmetric": Row(_named("asymmetric"), 0.96, 20, 65, 0.015),
    "down-only": Row(_one_way_only("down"), 0.96, 20, 65, 0.015),
    "up-only": Row(_one_way_only("up"), 0.96, 20, 65, 0.015),
    "lossy-10": Row(_named("lossy-10"), 0.96, 20, 70, 0.013),
    "lossy-20": Row(_named("lossy-20"), 0.96, 20, 70, 0.013),
    "jitter-5": Row(_jitter(5), 0.95, 30, 90, 0.04),
    "jitter-10": Row(_jitter(10), 0.95, 30, 90, 0.04),
    "blackouts": Row(_blackouts(1_000_000, 50, holds=False), 0.95, 20, 65, 0.01),
    "blackouts-hold": Row(_blackouts(1_000_000, 50, holds=True), 0.95, 20, 65, 0.01),
    "blackouts-thin": Row(_blackouts(100_000, 500, holds=False), 0.95, None, None, 0.01),
    "blackouts-thin-hold": Row(_blackouts(100_000, 500, holds=True), 0.95, None, None, None),
    "random": Row(random_profile, 0.90, 25, 500, 0.10),
    "random-alike": Row(_random_alike, 0.90, 25, 500, 0.10),
    "constant-9600": Row(lambda _: constant(9_600, 50 * NS_PER_MS), 0.95, 90, 220),
    "constant-10m": Row(lambda _: constant(10_000_000, 50 * NS_PER_MS), 0.97, 15, 30),
    "clocks": Row(_named("trials"), 0.96, 20, 65, 0.01, 0.12, 0.8, drift_ppm=200),
}

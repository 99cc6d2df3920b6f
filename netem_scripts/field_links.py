"""Links that a robot meets elsewhere: cut, far, or changing by the second.

Where no measurement is cited the numbers are ours, chosen to be hard; they are no claim about a network.
"""

from __future__ import annotations

from .band import Band, BurstLoss, DirectionProfile, Profile
from .draws import uniform

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000

_BLACKOUTS_S = (1, 3, 10, 30)
_UP_TIME_S = 20
_WALK_STEPS = 120
_RANDOM_BANDS = 40


def blackouts() -> Profile:
    """1 Mbit/s with 50 ms, cut for 1, 3, 10 and 30 s: what is sent meanwhile is lost."""
    return _blackouts("blackouts", "what leaves the queue meanwhile is lost", holds=False)


def blackouts_hold() -> Profile:
    """The same, but the queue waits for the end of the blackout."""
    return _blackouts("blackouts-hold", "the queue waits meanwhile", holds=True)


def satellite() -> Profile:
    """A geostationary satellite: 600 ms of round trip.

    The way up and down twice is 4 x 35,786 km, 477 ms, from right below, and 4 x 41,679 km, 556 ms, from
    where it stands on the horizon; the rest is for the modems. Rates, buffer and bursts of loss are ours.
    """
    rain = BurstLoss(0.0005, 0.1)  # bursts of ten packets, 0.5 % in all

    def direction(rate_bps: int) -> DirectionProfile:
        band = Band(60 * NS_PER_S, rate_bps, 300 * NS_PER_MS, burst_loss=rain)
        return DirectionProfile((band,), buffer_ns=2 * NS_PER_S)

    return Profile(
        "satellite",
        direction(512_000),
        direction(2_000_000),
        "down 512 kbit/s, up 2 Mbit/s, 300 ms each way, 0.5 % of loss in bursts",
        "geometry of the geostationary orbit; rates and loss are ours",
    )


def lte_walk() -> Profile:
    """A walk through cells: the rate changes each second, by an order of magnitude within some seconds.

    That cellular rates do so is the premise of Sprout (Winstein, Sivaraman, Balakrishnan, NSDI 2013), as are
    the seconds of buffer; the numbers here are ours: a reflected random walk of up to a factor of 1.6 per
    second.
    """

    def direction(which: str, low_bps: int, high_bps: int) -> DirectionProfile:
        bands, place = [], 0.5
        span = high_bps / low_bps
        for step in range(_WALK_STEPS):
            place += (uniform(f"lte-walk {which} {step}") - 0.5) * 0.29
            place = abs(place) if place < 1 else 2 - place
            rate_bps = round(low_bps * span**place)
            bands.append(Band(NS_PER_S, rate_bps, 30 * NS_PER_MS, jitter_ns=8 * NS_PER_MS))
        return DirectionProfile(tuple(bands), cyclic=True, buffer_ns=2 * NS_PER_S)

    return Profile(
        "lte-walk",
        direction("down", 300_000, 8_000_000),
        direction("up", 600_000, 16_000_000),
        "down 0.3 to 8 Mbit/s, up 0.6 to 16 Mbit/s, a step each second, 30 ms, jitter 8 ms, 2 min cycle",
        "shape after Sprout (NSDI 2013); numbers are ours",
    )


def hard_random() -> Profile:
    """Bands that nobody has announced: what an estimator without presets is judged by.

    Rate log-uniform from 50 kbit/s to 3 Mbit/s, delay 10 to 600 ms, 10 to 40 s each, 5 % loss, jitter 3 ms.
    """

    def direction(which: str) -> DirectionProfile:
        bands = []
        for number in range(_RANDOM_BANDS):
            dwell, rate, delay = (
                uniform(f"hard-random {which} {number} {what}") for what in ("dwell", "rate", "delay")
            )
            bands.append(
                Band(
                    round((10 + 30 * dwell) * NS_PER_S),
                    round(50_000 * 60**rate),
                    round((10 + 590 * delay) * NS_PER_MS),
                    loss_ratio=0.05,
                    jitter_ns=3 * NS_PER_MS,
                )
            )
        return DirectionProfile(tuple(bands), cyclic=True, buffer_ns=10 * NS_PER_S)

    return Profile(
        "hard-random",
        direction("down"),
        direction("up"),
        "50 kbit/s to 3 Mbit/s, 10 to 600 ms, 10 to 40 s each, loss 5 %, jitter 3 ms, directions apart",
        "ours",
    )


def _blackouts(name: str, effect: str, *, holds: bool) -> Profile:
    bands = []
    for dark_s in _BLACKOUTS_S:
        bands.append(Band(_UP_TIME_S * NS_PER_S, 1_000_000, 50 * NS_PER_MS))
        if holds:
            bands.append(Band(dark_s * NS_PER_S, 0, 50 * NS_PER_MS))
        else:
            bands.append(Band(dark_s * NS_PER_S, 1_000_000, 50 * NS_PER_MS, loss_ratio=1.0))
    direction = DirectionProfile(tuple(bands), cyclic=True, buffer_ns=10 * NS_PER_S)
    return Profile(
        name,
        direction,
        direction,
        f"1 Mbit/s with 50 ms, cut for 1, 3, 10 and 30 s after 20 s each; {effect}",
        "lengths of the Finals' blackouts; the rest is ours",
    )

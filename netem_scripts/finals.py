"""The DARPA Robotics Challenge Finals of June 2015, from the organisers' scripts for the Maxwell Pro box.

Figures from `dce_ctl.py` in oh-distro, software/network/maxwell-pro. Slow link: 9,600 bit/s each way, always
on, 5,000 bytes of queue, a packet charged as max(60, IP bytes) + 14. Fast link: 300 Mbit/s from the robot
only, a queue of 256 x 1,500 bytes; in a blackout everything is dropped and the queue is emptied. Neither adds
a delay.

Blackouts after `2015-2-2_Degraded_Comms_Schedule_Example.csv`: windows of 1 s, 370 blackouts of whole seconds
from 1 to 30, mean 6.4, median 4, seven of 30 s; the last ends at 45:37, from then on the link is open. The
example's blackouts get shorter in its course (five-minute means from 11.4 down to 3.2 s); ours do not.
"""

from __future__ import annotations

import math
from statistics import NormalDist

from .band import Band, DirectionProfile, Profile
from .draws import uniform

NS_PER_S = 1_000_000_000
SLOW_BPS = 9_600
SLOW_QUEUE_BYTES = 5_000
FAST_BPS = 300_000_000
FAST_QUEUE_BYTES = 256 * 1_500
WINDOW_S = 1
BLACKOUTS = 370
_ETHERNET_AND_IP_UDP_BYTES = 14 + 28
_MINIMUM_BYTES = 60 + 14
_CLEAR_NS = FAST_QUEUE_BYTES * 8 * NS_PER_S // FAST_BPS  # 10.24 ms: how long a full queue of the fast link is

# Log-normal of median 4, cut at 1 and 30, as quantiles: with these two the mean is 6.4 and seven are of 30 s.
_SIGMA = 0.97
_ROUND_UP_S = 0.285


def finals_slow() -> Profile:
    """The slow link of the Finals alone."""
    direction = _slow((Band(60 * NS_PER_S, SLOW_BPS, 0),))
    return Profile("finals-slow", direction, direction, "9,600 bit/s for ever, 5,000 B of queue", _SOURCE)


def finals_fast(seed: int = 1) -> Profile:
    """The fast link of the Finals alone: robot to team, nothing ever comes back."""
    bands = [Band(WINDOW_S * NS_PER_S, FAST_BPS, 0)]
    for dark_s in blackouts_s(seed):
        bands += (
            Band(dark_s * NS_PER_S, FAST_BPS, 0, loss_ratio=1.0),
            Band(WINDOW_S * NS_PER_S, FAST_BPS, 0),
        )
    down = DirectionProfile(tuple(bands), buffer_bytes=FAST_QUEUE_BYTES)
    up = DirectionProfile((Band(60 * NS_PER_S, FAST_BPS, 0, loss_ratio=1.0),), buffer_bytes=FAST_QUEUE_BYTES)
    name = "finals-fast" if seed == 1 else f"finals-fast-{seed}"
    description = "down 300 Mbit/s in 1 s windows between 1 to 30 s of nothing, no way back"
    return Profile(name, down, up, description, _SOURCE)


def finals(seed: int = 1) -> Profile:
    """Both links of the Finals as one: down is fast in the windows and slow in the dark, up is always slow.

    What the fast link has queued as the dark begins is lost, as it was there.
    """
    bands = [Band(WINDOW_S * NS_PER_S, FAST_BPS, 0)]
    for dark_s in blackouts_s(seed):
        bands += (
            Band(_CLEAR_NS, FAST_BPS, 0, loss_ratio=1.0),
            Band(dark_s * NS_PER_S - _CLEAR_NS, SLOW_BPS, 0),
            Band(WINDOW_S * NS_PER_S, FAST_BPS, 0),
        )
    down = DirectionProfile(
        tuple(bands),
        buffer_ns=SLOW_QUEUE_BYTES * 8 * NS_PER_S // SLOW_BPS,  # 4.17 s: binds while slow
        buffer_bytes=FAST_QUEUE_BYTES,  # binds while fast
        overhead_bytes=_ETHERNET_AND_IP_UDP_BYTES,
        minimum_bytes=_MINIMUM_BYTES,
    )
    description = "down 300 Mbit/s in 1 s windows between 1 to 30 s of 9,600 bit/s, up 9,600 bit/s"
    name = "finals" if seed == 1 else f"finals-{seed}"
    return Profile(name, down, _slow((Band(60 * NS_PER_S, SLOW_BPS, 0),)), description, _SOURCE)


def blackouts_s(seed: int) -> list[int]:
    """The lengths of the blackouts in their order; the seed changes the order only."""
    normal = NormalDist()
    lengths_s = []
    for number in range(BLACKOUTS):
        quantile_s = 4 * math.exp(_SIGMA * normal.inv_cdf((number + 0.5) / BLACKOUTS))
        lengths_s.append(min(30, max(1, round(quantile_s + _ROUND_UP_S))))
    order = sorted(range(BLACKOUTS), key=lambda number: uniform(f"finals {seed} {number}"))
    return [lengths_s[number] for number in order]


def _slow(bands: tuple[Band, ...]) -> DirectionProfile:
    return DirectionProfile(
        bands,
        buffer_bytes=SLOW_QUEUE_BYTES,
        overhead_bytes=_ETHERNET_AND_IP_UDP_BYTES,
        minimum_bytes=_MINIMUM_BYTES,
    )


_SOURCE = "DRC Finals 2015, dce_ctl.py and example schedule in oh-distro's network/maxwell-pro"

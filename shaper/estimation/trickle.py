"""What leaves while the link is held: little, and the less the longer it lasts.

A link that went dark may keep all of it, and serve it before anything new.
"""

from __future__ import annotations

from shaper.estimation.virtual_queue import VirtualQueue

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000

TRICKLE_BYTES = 54  # on the wire: large enough to be timed
TRICKLE_SHARE = 0.015  # at most this share of the rate is taken, as a link may hold the queue ...
TRICKLE_NS = 20 * NS_PER_MS, 100 * NS_PER_MS  # ... and no more than one per round trip, in these bounds
TRICKLE_SLOWING = 64  # its interval is at least the silence over this ...
MAX_TRICKLE_NS, MAX_TRICKLE_RTTS = 150 * NS_PER_MS, 2.0  # ... or this, as its end is noticed no sooner ...
LONG_SLOWING = 640  # ... but by round trips only while a few of them are much of the silence
LONGEST_TRICKLE_NS = 2_000 * NS_PER_MS
URGENT_SLOWING = 8  # and that of heartbeats the silence over this ...
CHANGE_NS, CHANGE_RTTS = 1_000 * NS_PER_MS, 1.5  # ... or all beyond what another band takes to answer ...
URGENT_TRICKLES, LEAST_URGENT_NS = 4, 600 * NS_PER_MS  # ... at most so many of those, or this


def trickle_ns(held_ns: int, rate_bps: float, rtt_ns: int) -> int:
    """How soon the next datagram leaves when the link has been held for so long."""
    share_ns = int(TRICKLE_BYTES * 8 * NS_PER_S / (TRICKLE_SHARE * rate_bps))
    least_ns = min(max(rtt_ns, TRICKLE_NS[0]), TRICKLE_NS[1])
    most_ns = min(int(MAX_TRICKLE_RTTS * rtt_ns), MAX_TRICKLE_NS)
    slowed_ns = max(min(held_ns // TRICKLE_SLOWING, most_ns), min(held_ns // LONG_SLOWING, MAX_TRICKLE_NS))
    return max(least_ns, min(share_ns, LONGEST_TRICKLE_NS), slowed_ns)


def urgent_trickle_ns(held_ns: int, rate_bps: float, rtt_ns: int) -> int:
    """How soon the next message that always passes may leave after one."""
    change_ns = max(CHANGE_NS, int(CHANGE_RTTS * rtt_ns))
    slowed_ns = max(held_ns // URGENT_SLOWING, held_ns - change_ns)
    return min(slowed_ns, max(URGENT_TRICKLES * trickle_ns(held_ns, rate_bps, rtt_ns), LEAST_URGENT_NS))


def pace_trickle(
    pacer: VirtualQueue,
    held_ns: int,
    rate_bps: float,
    rtt_ns: int,
    now_ns: int,
    *,
    in_train: bool,
    carried: bool,
) -> None:
    """A datagram has left: set when the next may. carried: it held a message that always passes."""
    if not in_train:
        pacer.not_before_ns = now_ns + trickle_ns(held_ns, rate_bps, rtt_ns)
    if carried:
        pacer.urgent_from_ns = now_ns + urgent_trickle_ns(held_ns, rate_bps, rtt_ns)

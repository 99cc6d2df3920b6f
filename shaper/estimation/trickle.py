"""What leaves while the link is held: little, and the less the longer it lasts.

A link that went dark may keep all of it, and serve it before anything new.
"""

from __future__ import annotations

from shaper.estimation.virtual_queue import VirtualQueue

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000

TRICKLE_BYTES = 54  # on the wire: large enough to be timed
TRICKLE_NS = 100 * NS_PER_MS  # a datagram at least this often is not needed ...
TRICKLE_SHARE = 0.015  # ... and at most this share of the rate is taken, as a link may hold the queue
TRICKLE_SLOWING = 64  # its interval is at least the silence over this ...
MAX_TRICKLE_NS = 150 * NS_PER_MS  # ... or this, as a blackout's end is noticed no sooner
LONGEST_TRICKLE_NS = 2_000 * NS_PER_MS
URGENT_SLOWING = 8  # and that of heartbeats the silence over this, at most ...
URGENT_TRICKLES = 4  # ... so many of those


def trickle_ns(held_ns: int, rate_bps: float) -> int:
    """How soon the next datagram leaves when the link has been held for so long."""
    share_ns = int(TRICKLE_BYTES * 8 * NS_PER_S / (TRICKLE_SHARE * rate_bps))
    slowed_ns = min(held_ns // TRICKLE_SLOWING, MAX_TRICKLE_NS)
    return max(TRICKLE_NS, min(share_ns, LONGEST_TRICKLE_NS), slowed_ns)


def urgent_trickle_ns(held_ns: int, rate_bps: float) -> int:
    """How soon the next message that always passes may leave after one."""
    return min(held_ns // URGENT_SLOWING, URGENT_TRICKLES * trickle_ns(held_ns, rate_bps))


def pace_trickle(
    pacer: VirtualQueue, held_ns: int, rate_bps: float, now_ns: int, *, in_train: bool, carried: bool
) -> None:
    """A datagram has left: set when the next may. carried: it held a message that always passes."""
    if not in_train:
        pacer.not_before_ns = now_ns + trickle_ns(held_ns, rate_bps)
    if carried:
        pacer.urgent_from_ns = now_ns + urgent_trickle_ns(held_ns, rate_bps)

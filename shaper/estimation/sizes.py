"""How large datagrams are, on the wire: full ones, and those of trains."""

from __future__ import annotations

from functools import lru_cache

from shaper.link_estimator import datagram_wire_bytes

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000
LEAST_DATAGRAM_BYTES = 180  # on the thinnest links, where a larger one ...
MOST_AIRTIME_NS = 150 * NS_PER_MS  # ... would take longer than this
TRAIN_BYTES = 150  # small, as the link may be thin now, and large against headers
TRAIN_AIRTIME_NS = 8 * NS_PER_MS  # of a train's datagram while the rate is known ...
TRAIN_NOISES = 2.0  # ... and this much per noise of arrivals


@lru_cache(maxsize=64)  # asked some times per datagram, at a rate that seldom changes
def full_bytes(rate_bps: int, most_bytes: int) -> int:
    """Size of a full datagram at a rate."""
    wire_bytes = datagram_wire_bytes(rate_bps, most_bytes)
    longest_bytes = rate_bps * MOST_AIRTIME_NS // (8 * NS_PER_S)
    return max(min(wire_bytes, longest_bytes), min(wire_bytes, LEAST_DATAGRAM_BYTES))


def train_bytes(rate_bps: int, noise_ns: float, most_bytes: int) -> int:
    """Size of a train's datagram. noise_ns: sigma of one arrival."""
    airtime_ns = TRAIN_AIRTIME_NS + int(TRAIN_NOISES * noise_ns)
    return min(most_bytes, max(TRAIN_BYTES, rate_bps * airtime_ns // (8 * NS_PER_S)))

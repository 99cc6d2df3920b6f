"""Packets that the peer would have reported by now, had the link not changed."""

from __future__ import annotations

from collections.abc import Sequence

from shaper.estimation.flights import Flight
from shaper.frames import STAMP_BITS
from shaper.serial_number import expand

NS_PER_S = 1_000_000_000
OVERDUE_NS = 15_000_000  # a report may be this late ...
OVERDUE_SHARE = 0.15  # ... and this share of the queue that the packet was to meet
NOISES = 6
REPORT_LAG_NS = 25_000_000  # an arrival is reported within this, if no report is lost


def is_overdue(
    unreported: Sequence[Flight],
    misses: tuple[int, int],
    delay_ns: int,
    rate_bps: float,
    noise_ns: float,
    peer_us: int,
) -> bool:
    """Whether so many packets in a row as loss does not explain are missing in what the peer knew.

    misses: of ours, and of the peer's, that loss explains. delay_ns: of the empty link, plus the clocks'
    offset. peer_us: the stamp of the peer's newest datagram.
    """
    ours, theirs = misses
    if len(unreported) < ours:
        return False
    last = unreported[ours - 1]
    due_ns = last.sent_ns + delay_ns + last.wait_ns + int(last.bits * NS_PER_S / rate_bps)
    margin_ns = OVERDUE_NS + REPORT_LAG_NS * theirs + NOISES * noise_ns + OVERDUE_SHARE * last.wait_ns
    return expand((peer_us - due_ns // 1000) % (1 << STAMP_BITS), STAMP_BITS, 0) * 1000 > margin_ns

"""When to speak although no message asks for it: beats, reports, probes, and the trickle in silence."""

from __future__ import annotations

from dataclasses import dataclass

from shaper.incoming import Incoming
from shaper.pacer import NS_PER_S
from shaper.path import Path

BEAT_INTERVAL_NS = 1_000_000_000  # each side says at least this often that it is there
SEARCH_INTERVAL_NS = 500_000_000  # the same while the peer has never been heard
REPORT_INTERVAL_NS = 50_000_000  # a report leaves at most this long after what it reports on ...
REPORT_SHARE = 0.03  # ... but pure reports take no more than this share of our own direction
SILENCE_NS = 3_000_000_000  # without a datagram from the peer: the link is taken to be dark
_REPORT_WIRE_BYTES = 75  # a typical pure report: headers, a report of ten arrivals
_PIGGYBACK_NS = 20_000_000  # a datagram that leaves anyway carries a report if the last is older
# A probe asks for a report when a message waits for its outcome, or for room on a held link, and nothing
# has been sent for a while: a round trip and its variation, or just a round trip once the peer is silent.
_PROBE_INTERVAL_NS = 100_000_000
_PROBE_SHARE = 0.05  # and never more than this share of the rate
_PROBE_WIRE_BYTES = 47
# While the link is dark, heartbeats too leave only at a share of the rate: where a blackout holds the
# queue, all that was sent into it comes before anything new (30 s of it: 0.9 s of link).
_TRICKLE_SHARE = 0.03
_TRICKLE_WIRE_BYTES = 110
_ANY_TIME_NS = -(1 << 62)  # before any clock


@dataclass(frozen=True, slots=True)
class Due:
    """What must leave now, whether or not there are messages."""

    beat: bool = False
    report: bool = False
    probe: bool = False

    @property
    def anything(self) -> bool:
        return self.beat or self.report or self.probe


class Timers:
    """The instants that matter, and what follows from them at a rate.

    report_at_once: a peer just met gets its first report without waiting.
    """

    __slots__ = ("beat_at_ns", "last_heard_ns", "last_sent_ns", "report_at_once", "reported_at_ns")

    def __init__(self, now_ns: int) -> None:
        self.beat_at_ns = now_ns
        self.last_sent_ns = now_ns  # something that wants a report
        self.last_heard_ns = now_ns
        self.reported_at_ns = now_ns
        self.report_at_once = False

    def on_peer_met(self, now_ns: int) -> None:
        """It waits for nothing but our word."""
        self.report_at_once = True
        self.beat_at_ns = now_ns

    def on_beat(self, now_ns: int, *, searching: bool) -> None:
        """A beat leaves now."""
        self.beat_at_ns = now_ns + (SEARCH_INTERVAL_NS if searching else BEAT_INTERVAL_NS)

    def may_piggyback(self, now_ns: int) -> bool:
        """Whether a datagram that leaves anyway should carry a report."""
        return now_ns - self.reported_at_ns >= _PIGGYBACK_NS

    def is_dark(self, now_ns: int) -> bool:
        """Whether nothing has come for so long that the link is taken to be away."""
        return now_ns - self.last_heard_ns > SILENCE_NS

    def report_due_ns(self, incoming: Incoming | None, rate_bps: int) -> int | None:
        """When a report must leave by itself; None if nothing waits for one."""
        if incoming is None or incoming.unreported_since_ns is None:
            return None
        if self.report_at_once or incoming.after_silence:
            return incoming.unreported_since_ns
        share_ns = _airtime_ns(_REPORT_WIRE_BYTES, REPORT_SHARE, rate_bps)
        return incoming.unreported_since_ns + max(REPORT_INTERVAL_NS, share_ns)

    def probe_at_ns(self, path: Path, rate_bps: int) -> int:
        """When to ask for a report that something waits on."""
        silent = self.last_sent_ns - self.last_heard_ns > path.probe_timeout_ns()
        patience_ns = path.smoothed_rtt_ns if silent else path.probe_timeout_ns()
        share_ns = _airtime_ns(_PROBE_WIRE_BYTES, _PROBE_SHARE, rate_bps)
        return self.last_sent_ns + max(_PROBE_INTERVAL_NS, share_ns, patience_ns)

    def trickle_at_ns(self, rate_bps: int) -> int:
        """When the next datagram may leave although nothing comes back."""
        if not self.is_dark(self.last_sent_ns):
            return _ANY_TIME_NS
        share_ns = _airtime_ns(_TRICKLE_WIRE_BYTES, _TRICKLE_SHARE, rate_bps)
        return self.last_sent_ns + max(_PROBE_INTERVAL_NS, share_ns)


def _airtime_ns(wire_bytes: int, share: float, rate_bps: int) -> int:
    """How far apart datagrams of a size are that take a share of the rate."""
    return int(wire_bytes * 8 * NS_PER_S / (share * rate_bps))

"""When to speak although no message asks for it: beats, reports, probes, and the trickle in silence."""

from __future__ import annotations

from typing import NamedTuple

from shaper.incoming import Incoming
from shaper.pacer import NS_PER_S
from shaper.path import Path
from shaper.promise import PROMISES_NS, promise_code

BEAT_INTERVAL_NS = 1_000_000_000  # each side says at least this often that it is there
SEARCH_INTERVAL_NS = 500_000_000  # the same while the peer has never been heard
REPORT_INTERVAL_NS = 50_000_000  # a report leaves at most this long after what it reports on ...
STREAM_REPORT_INTERVAL_NS = 25_000_000  # ... or this, while more is promised to come soon ...
REPORT_SHARE = 0.03  # ... but pure reports take no more than this share of our own direction ...
IDLE_REPORT_SHARE = 0.10  # ... or this, while it carries nothing else
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
# What is promised (shaper.promise): the next datagram of a backlog, with this much for a late timer; or
# the next report, while there is something to report on; or twice the gap between datagrams of late; or,
# if that is long, the next beat. A regular stream that falls silent is missed after two of its periods,
# not a second; when traffic ends, a few empty datagrams leave, each after twice the time.
_PACE_SLACK_NS = 3_000_000
_GAP_FACTOR, _GAP_WEIGHT = 2, 8
_REGULAR_NS = 400_000_000
_BEAT_SLACK_NS = 20_000_000
_ANY_TIME_NS = -(1 << 62)  # before any clock


class Due(NamedTuple):
    """What must leave now, whether or not there are messages."""

    beat: bool = False
    report: bool = False
    probe: bool = False
    promised: bool = False

    @property
    def anything(self) -> bool:
        return self.beat or self.report or self.probe or self.promised


NOTHING_DUE = Due()


class Timers:
    """The instants that matter, and what follows from them at a rate.

    report_at_once: a peer just met gets its first report without waiting.
    """

    __slots__ = (
        "_gap_ns",
        "_spoke_ns",
        "beat_at_ns",
        "last_heard_ns",
        "last_sent_ns",
        "promised_until_ns",
        "report_at_once",
        "reported_at_ns",
    )

    def __init__(self, now_ns: int) -> None:
        self.beat_at_ns = now_ns
        self.last_sent_ns = now_ns  # something that wants a report
        self.last_heard_ns = now_ns
        self.reported_at_ns = now_ns
        self.report_at_once = False
        self._spoke_ns = now_ns  # anything at all
        self._gap_ns = BEAT_INTERVAL_NS  # smoothed, between all datagrams
        self.promised_until_ns = 1 << 62  # nothing is promised before anything is sent

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

    def promise_code(
        self, incoming: Incoming | None, backlog_at_ns: int | None, interval_ns: int, now_ns: int
    ) -> int:
        """Promise when the next datagram follows one that leaves now; the promise's code.

        backlog_at_ns: when what waits may leave; None if nothing does. interval_ns: between pure reports.
        """
        gap_ns, self._spoke_ns = now_ns - self._spoke_ns, now_ns
        self._gap_ns += (gap_ns - self._gap_ns) // _GAP_WEIGHT
        if backlog_at_ns is not None:
            within_ns = backlog_at_ns - now_ns + _PACE_SLACK_NS
        elif incoming is not None and now_ns < incoming.streams_until_ns + interval_ns:
            within_ns = interval_ns + _PACE_SLACK_NS
        else:
            usual_ns = _GAP_FACTOR * max(gap_ns, self._gap_ns, interval_ns)
            within_ns = usual_ns if usual_ns < _REGULAR_NS else BEAT_INTERVAL_NS
            within_ns += _BEAT_SLACK_NS
        code = promise_code(within_ns)
        self.promised_until_ns = now_ns + PROMISES_NS[code]
        return code

    def report_interval_ns(self, incoming: Incoming | None, rate_bps: int, *, idle: bool) -> int:
        """How far apart pure reports are. idle: nothing else leaves."""
        streams = incoming is not None and self.last_heard_ns < incoming.streams_until_ns
        share = IDLE_REPORT_SHARE if idle else REPORT_SHARE
        least_ns = STREAM_REPORT_INTERVAL_NS if streams else REPORT_INTERVAL_NS
        return max(least_ns, _airtime_ns(_REPORT_WIRE_BYTES, share, rate_bps))

    def report_due_ns(self, incoming: Incoming | None, interval_ns: int) -> int | None:
        """When a report must leave by itself; None if nothing waits for one."""
        if incoming is None or incoming.unreported_since_ns is None:
            return None
        if self.report_at_once or incoming.after_silence:
            return incoming.unreported_since_ns
        return incoming.unreported_since_ns + interval_ns

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

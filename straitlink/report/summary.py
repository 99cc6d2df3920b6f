"""A run in figures: per topic and per direction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from .age import sawtooth
from .run import DIRECTIONS, Run, Times, known


@dataclass(frozen=True, slots=True)
class Spread:
    """Median, 95th percentile (the smallest observed value that 95 % do not exceed) and maximum."""

    p50_ns: int
    p95_ns: int
    max_ns: int


@dataclass(frozen=True, slots=True)
class TopicSummary:
    """One topic. None: no trace tells. age_of_information is weighted by time, the other two by delivery.

    lost: sent and never come, where both ends were traced: then no message is in two of the counters.
    stale: came, but a newer one had overtaken it. refused, unreadable: its encoding could not carry it, or
    not be read.
    """

    topic: str
    direction: str
    offered: int | None
    decimated: int | None
    sent: int | None
    delivered: int | None
    superseded: int | None
    expired: int | None
    overflow: int | None
    refused: int | None
    stale: int | None
    unreadable: int | None
    lost: int | None
    payload_bytes: int | None
    one_way_delay: Spread | None
    age_at_delivery: Spread | None
    age_of_information: Spread | None


@dataclass(frozen=True, slots=True)
class DirectionSummary:
    """One direction of the link.

    wire_bytes: through the link where it was traced, else put on the wire by the sender.
    utilisation: share (0..1) of what the true rate could have carried over the run.
    queue_delay: in the link's buffer, of packets that it did not drop.
    """

    direction: str
    wire_bytes: int
    capacity_bytes: int | None
    utilisation: float | None
    queue_delay: Spread | None
    packets: int | None
    dropped: int | None


@dataclass(frozen=True, slots=True)
class Summary:
    """All figures of a run; topics by direction (down first), then name."""

    duration_s: float
    topics: tuple[TopicSummary, ...]
    directions: tuple[DirectionSummary, ...]
    malformed_lines: int


def summarise(run: Run) -> Summary:
    """The figures of a run."""
    names = sorted({*run.topics, *run.deliveries}, key=lambda topic: (run.topics[topic], topic))
    traced = [side for side in DIRECTIONS if side in run.packets or side in run.departures]
    return Summary(
        duration_s=run.duration_ns / 1e9,
        topics=tuple(_topic(run, topic) for topic in names),
        directions=tuple(_direction(run, side) for side in traced),
        malformed_lines=run.malformed_lines,
    )


def _topic(run: Run, topic: str) -> TopicSummary:
    ledger = run.ledgers.get(topic, {})
    deliveries = run.deliveries.get(topic)
    course = None if deliveries is None else sawtooth(deliveries, run.duration_ns)
    delivered, payload_bytes = _arrived(run, topic, ledger)
    return TopicSummary(
        topic=topic,
        direction=run.topics[topic],
        offered=ledger.get("offered"),
        decimated=ledger.get("decimated"),
        sent=ledger.get("sent"),
        delivered=delivered,
        superseded=ledger.get("superseded"),
        expired=_expired(run, topic, ledger),
        overflow=ledger.get("overflow"),
        refused=ledger.get("refused"),
        stale=ledger.get("stale"),
        unreadable=ledger.get("unreadable"),
        lost=_lost(run, topic, ledger, delivered),
        payload_bytes=payload_bytes,
        one_way_delay=None if deliveries is None else spread(deliveries.one_way_delay_ns),
        age_at_delivery=None if deliveries is None else spread(deliveries.age_ns),
        age_of_information=None if course is None else Spread(*course.quantiles_ns((0.50, 0.95, 1.0))),
    )


def _arrived(run: Run, topic: str, ledger: Mapping[str, int]) -> tuple[int | None, int | None]:
    """(messages delivered, their payload bytes); None where the receiver was not traced."""
    deliveries = run.deliveries.get(topic)
    if deliveries is not None:
        seen = int(deliveries.t_ns.size)
        return max(seen, ledger.get("delivered", 0)), int(deliveries.payload_bytes.sum())
    receiver = "operator" if run.topics[topic] == "down" else "robot"
    return (ledger.get("delivered", 0), 0) if receiver in run.sides else (None, None)


def _expired_there(run: Run, topic: str, ledger: Mapping[str, int]) -> int:
    """Messages that came too late, of which the sender was not told."""
    return 0 if topic in run.reliable else ledger.get("expired_there", 0)


def _expired(run: Run, topic: str, ledger: Mapping[str, int]) -> int | None:
    """At either end; the receiver alone cannot know how many expired before they came."""
    return ledger["expired"] + _expired_there(run, topic, ledger) if "expired" in ledger else None


def _lost(run: Run, topic: str, ledger: Mapping[str, int], delivered: int | None) -> int | None:
    """Sent and neither delivered nor dropped on arrival; without the sender, what the receiver counts.

    The receiver counts message numbers that were passed over, and so also messages of which the sender
    gave up the rest midway, which the sender counts as expired.
    """
    if "sent" not in ledger or delivered is None:
        return ledger.get("lost")
    dropped = _expired_there(run, topic, ledger) + ledger.get("stale", 0) + ledger.get("unreadable", 0)
    return max(ledger["sent"] - delivered - dropped, 0)  # a killed sender's last ledger may be 1 s old


def _direction(run: Run, side: str) -> DirectionSummary:
    packets, departures, bands = run.packets.get(side), run.departures.get(side), run.bands.get(side)
    if packets is not None:
        wire_bytes = int(packets.carried(run.duration_ns)[1].sum())
    else:
        wire_bytes = int(departures.wire_bytes.sum()) if departures is not None else 0
    capacity_bytes = None if bands is None else round(bands.integral(run.duration_ns) / 8)
    return DirectionSummary(
        direction=side,
        wire_bytes=wire_bytes,
        capacity_bytes=capacity_bytes,
        utilisation=wire_bytes / capacity_bytes if capacity_bytes else None,
        queue_delay=None if packets is None else spread(packets.queue_delay_ns[~packets.dropped]),
        packets=None if packets is None else packets.t_ns.size,
        dropped=None if packets is None else int(packets.dropped.sum()),
    )


def spread(values_ns: Times) -> Spread | None:
    """The spread of known values, each counted once; None without any."""
    values_ns = values_ns[known(values_ns)]
    if not values_ns.size:
        return None
    p50, p95 = np.percentile(values_ns, (50, 95), method="inverted_cdf")
    return Spread(int(p50), int(p95), int(values_ns.max()))

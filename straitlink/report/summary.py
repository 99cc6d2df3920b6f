"""A run in figures: per topic and per direction."""

from __future__ import annotations

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
    """One topic. None: no trace tells. age_of_information is weighted by time, the other two by delivery."""

    topic: str
    direction: str
    offered: int | None
    decimated: int | None
    sent: int | None
    delivered: int
    superseded: int | None
    expired: int | None
    overflow: int | None
    lost: int | None
    payload_bytes: int
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
    packets: int
    dropped: int


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
    seen = 0 if deliveries is None else deliveries.t_ns.size
    return TopicSummary(
        topic=topic,
        direction=run.topics[topic],
        offered=ledger.get("offered"),
        decimated=ledger.get("decimated"),
        sent=ledger.get("sent"),
        delivered=max(seen, ledger.get("delivered", 0)),
        superseded=ledger.get("superseded"),
        expired=ledger.get("expired"),
        overflow=ledger.get("overflow"),
        lost=ledger.get("lost"),
        payload_bytes=0 if deliveries is None else int(deliveries.payload_bytes.sum()),
        one_way_delay=None if deliveries is None else spread(deliveries.one_way_delay_ns),
        age_at_delivery=None if deliveries is None else spread(deliveries.age_ns),
        age_of_information=None if course is None else Spread(*course.quantiles_ns((0.50, 0.95, 1.0))),
    )


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
        packets=0 if packets is None else packets.t_ns.size,
        dropped=0 if packets is None else int(packets.dropped.sum()),
    )


def spread(values_ns: Times) -> Spread | None:
    """The spread of known values, each counted once; None without any."""
    values_ns = values_ns[known(values_ns)]
    if not values_ns.size:
        return None
    p50, p95 = np.percentile(values_ns, (50, 95), method="inverted_cdf")
    return Spread(int(p50), int(p95), int(values_ns.max()))

"""From what both sides and the link noted to the figures of a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from netem_scripts.band import DirectionProfile
from netem_scripts.records import PacketRecord
from straitlink.mission.load import Load

Notes = dict[str, Any]  # as bench.peers.side writes them


@dataclass(frozen=True, slots=True)
class Window:
    """One band of the run while the load plays. begin_ns, end_ns: the host's monotonic clock."""

    name: str
    begin_ns: int
    end_ns: int
    rate_bps: int


@dataclass(frozen=True, slots=True)
class TopicFigures:
    """Of the messages captured in a window. in_window: delivered before it ended. age: None if none came."""

    offered: int
    delivered: int
    in_window: int
    age_p50_ms: float | None
    age_p95_ms: float | None
    age_max_ms: float | None


@dataclass(frozen=True, slots=True)
class LinkFigures:
    """Robot to operator, in a window. used: wire bytes served of those that the band could serve."""

    used: float
    queue_p50_ms: float
    queue_p95_ms: float
    queue_max_ms: float
    dropped: int


def windows_of(direction: DirectionProfile, link_began_ns: int, begin_ns: int, end_ns: int) -> list[Window]:
    """The bands of the schedule, cut to the time in which the load plays."""
    found, band_began_ns = [], link_began_ns
    for number, band in enumerate(direction.bands, start=1):
        band_ends_ns = band_began_ns + band.duration_ns
        first, last = max(band_began_ns, begin_ns), min(band_ends_ns, end_ns)
        if first < last:
            dark = band.rate_bps == 0 or band.loss_ratio == 1.0
            kind = (
                "dark" if dark else f"{band.rate_bps // 1000} kbit/s {band.one_way_delay_ns // 1_000_000} ms"
            )
            found.append(Window(f"{number}: {kind}", first, last, 0 if dark else band.rate_bps))
        band_began_ns = band_ends_ns
    return found


def topic_figures(load: Load, robot: Notes, operator: Notes, window: Window) -> dict[str, TopicFigures]:
    """By key, for every topic that crosses."""
    figures = {}
    for topic in load.topics:
        if topic.traffic_class is None:
            continue
        sender, receiver = (robot, operator) if topic.direction == "down" else (operator, robot)
        offered = [ns for ns in sender["offered"].get(topic.key, []) if _inside(ns, window)]
        first: dict[int, tuple[int, int]] = {}  # the first copy counts
        for number, captured_ns, arrived_ns in receiver["arrivals"].get(topic.key, []):
            if _inside(captured_ns, window):
                first.setdefault(number, (captured_ns, arrived_ns))
        ages_ms = sorted((arrived - captured) / 1e6 for captured, arrived in first.values())
        figures[topic.key] = TopicFigures(
            len(offered),
            len(first),
            sum(arrived <= window.end_ns for _, arrived in first.values()),
            _quantile(ages_ms, 0.5),
            _quantile(ages_ms, 0.95),
            ages_ms[-1] if ages_ms else None,
        )
    return figures


def link_figures(packets: Sequence[PacketRecord], window: Window) -> LinkFigures | None:
    """Of the way down; None in the dark."""
    if not window.rate_bps:
        return None
    served = 0
    delays_ms = []
    for packet in packets:
        if packet.dropped is not None or packet.direction != "down":
            continue
        leaves_ns = packet.t_ns + packet.queue_delay_ns
        if _inside(leaves_ns, window):
            served += packet.wire_bytes
        if _inside(packet.t_ns, window):
            delays_ms.append(packet.queue_delay_ns / 1e6)
    delays_ms.sort()
    capacity = window.rate_bps * (window.end_ns - window.begin_ns) / 8e9
    dropped = sum(
        p.dropped is not None and p.direction == "down" and _inside(p.t_ns, window) for p in packets
    )
    return LinkFigures(
        served / capacity,
        _quantile(delays_ms, 0.5) or 0.0,
        _quantile(delays_ms, 0.95) or 0.0,
        delays_ms[-1] if delays_ms else 0.0,
        dropped,
    )


def _inside(instant_ns: int, window: Window) -> bool:
    return window.begin_ns <= instant_ns < window.end_ns


def _quantile(ordered: Sequence[float], share: float) -> float | None:
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))] if ordered else None

"""The page's plots as data: series binned so that any run stays small."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .age import sawtooth
from .figures import count, percent, rate, seconds, size
from .run import DIRECTIONS, Estimate, Run, Steps, Times
from .summary import DirectionSummary, Spread, Summary

MAX_BINS = 1200
MIN_BIN_NS = 250_000_000
COUNT_BIN_NS = 2_000_000_000  # narrower, and a 1 Hz topic flickers between 0 and 4 per second
MAX_COUNT_BINS = 450
LEAST_S = 0.001  # what a logarithmic axis shows of zero

Plot = dict[str, Any]
WAY_NAMES = {"down": "robot → operator", "up": "operator → robot"}
WAY_COLOURS = {"down": 0, "up": 1}  # indices into the page's palette


def plots(run: Run, summary: Summary) -> list[Plot]:
    """Every plot that the run's traces can fill, in the order of the page."""
    edges_ns = _edges(run.duration_ns, MIN_BIN_NS, MAX_BINS)
    colours = {row.topic: index for index, row in enumerate(summary.topics)}
    made = [_throughput(run, row, edges_ns) for row in summary.directions]
    made += [_queue_delay(run, summary, edges_ns), _age(run, summary, edges_ns, colours)]
    for side in (side for side in DIRECTIONS if side in run.estimates):
        made += [_estimated_rate(run, side, edges_ns), _estimated_queue(run, side, edges_ns)]
    made += [_belief(run, edges_ns), _estimate_ratio(run, edges_ns), _delivered(run, summary, colours)]
    return [plot for plot in made if plot["series"]]


def band_spans(run: Run) -> dict[str, list[list[float]]]:
    """Per direction the true rate as [from s, to s, rate bit/s], for shading."""
    spans = {}
    for side, band in run.bands.items():
        begins = np.clip(band.t_ns, 0, run.duration_ns)
        begins[0] = 0
        ends = np.append(begins[1:], run.duration_ns)
        rows = zip(begins / 1e9, ends / 1e9, band.value, strict=True)
        spans[side] = [[round(a, 3), round(b, 3), int(rate_bps)] for a, b, rate_bps in rows if b > a]
    return spans


def _throughput(run: Run, row: DirectionSummary, edges_ns: Times) -> Plot:
    side = row.direction
    t_ns, wire_bytes = _carried(run, side)
    widths_s = np.diff(edges_ns) / 1e9
    sums, _ = np.histogram(t_ns, edges_ns, weights=wire_bytes)
    series = []
    band = run.bands.get(side)
    if band is not None:
        true = band.at(_middles(edges_ns)) / 8e3
        series.append(_series("true rate", true, "the link's band", shape="area"))
    figure = f"{size(row.wire_bytes)}, {percent(row.utilisation)} used" if band else size(row.wire_bytes)
    series.append(_series("on the wire", sums / widths_s / 1e3, figure, WAY_COLOURS[side]))
    title = f"Bytes on the wire, {WAY_NAMES[side]}"
    return _plot(title, "kB/s", edges_ns, series, side=side, note="IP and UDP headers included")


def _carried(run: Run, side: str) -> tuple[Times, Times]:
    packets = run.packets.get(side)
    if packets is not None:
        return packets.carried(run.duration_ns)
    return run.departures[side].t_ns, run.departures[side].wire_bytes


def _queue_delay(run: Run, summary: Summary, edges_ns: Times) -> Plot:
    series = []
    for row in summary.directions:
        packets = run.packets.get(row.direction)
        if packets is None or row.queue_delay is None:
            continue
        through = ~packets.dropped
        worst = _bin_max(packets.t_ns[through], packets.queue_delay_ns[through], edges_ns)
        delay_s = np.maximum(worst / 1e9, LEAST_S)
        figure = _figure(row.queue_delay)
        series.append(_series(WAY_NAMES[row.direction], delay_s, figure, WAY_COLOURS[row.direction]))
    note = "time in the link's buffer, worst of each bin"
    return _plot("Queueing delay", "s", edges_ns, series, scale="log", note=note)


def _age(run: Run, summary: Summary, edges_ns: Times, colours: dict[str, int]) -> Plot:
    series = []
    for row in summary.topics:
        deliveries = run.deliveries.get(row.topic)
        course = None if deliveries is None else sawtooth(deliveries, run.duration_ns)
        if course is None:
            continue
        peak_s = np.maximum(course.peak_between(edges_ns) / 1e9, LEAST_S)
        figure = _figure(row.age_of_information)
        series.append(_series(row.topic, peak_s, figure, colours[row.topic]))
    note = "how old the newest sample at the receiver is, worst of each bin"
    return _plot("Age of information", "s", edges_ns, series, scale="log", note=note)


def _estimated_rate(run: Run, side: str, edges_ns: Times) -> Plot:
    middles_ns, estimate, series = _middles(edges_ns), run.estimates[side], []
    if side in run.bands:
        true = run.bands[side].at(middles_ns)
        series.append(_series("true rate", np.where(true > 0, true, np.nan), "the link's band", shape="area"))
    paced_bps = estimate.at(estimate.rate_bps, middles_ns)
    series.append(_series("estimate", paced_bps, _median(paced_bps, rate), WAY_COLOURS[side]))
    title = f"Estimated rate, {WAY_NAMES[side]}"
    return _plot(title, "bit/s", edges_ns, series, scale="log", side=side, note="what the sender paces at")


def _estimated_queue(run: Run, side: str, edges_ns: Times) -> Plot:
    estimate, packets, series = run.estimates[side], run.packets.get(side), []
    if not np.isfinite(estimate.queue_ns).any():
        return _plot("", "s", edges_ns, [])
    if packets is not None and packets.t_ns.size:
        through = ~packets.dropped
        worst_ns = _bin_max(packets.t_ns[through], packets.queue_delay_ns[through], edges_ns)
        met_s = np.maximum(worst_ns / 1e9, LEAST_S)
        series.append(_series("met by packets", met_s, "worst of each bin", shape="area"))
    queue_ns = _bin_max(estimate.t_ns, estimate.queue_ns, edges_ns)  # or as told last
    queue_ns = np.where(np.isnan(queue_ns), estimate.at(estimate.queue_ns, edges_ns[1:] - 1), queue_ns)
    queue_s = np.maximum(queue_ns / 1e9, LEAST_S)
    figure = _median(queue_ns, lambda value_ns: seconds(round(value_ns)))
    series.append(_series("estimate", queue_s, figure, WAY_COLOURS[side]))
    title, note = (
        f"Estimated queue, {WAY_NAMES[side]}",
        "time to drain what the link holds, worst of each bin",
    )
    return _plot(title, "s", edges_ns, series, scale="log", side=side, note=note)


def _belief(run: Run, edges_ns: Times) -> Plot:
    series = []
    for side in (side for side in DIRECTIONS if side in run.estimates):
        estimate = run.estimates[side]
        for colour, (name, figures) in enumerate(
            (("confidence", estimate.confidence), ("loss", estimate.loss_ratio))
        ):
            values = estimate.at(figures, _middles(edges_ns))
            if np.isfinite(values).any():
                name = f"{name}, {WAY_NAMES[side]}"
                series.append(
                    _series(name, values, _median(values, "{:.2f}".format), WAY_COLOURS[side] + 2 * colour)
                )
    note = "confidence: 0 blind, 1 measured and steady; loss of the packets reported on lately"
    return _plot("Confidence and loss", "ratio", edges_ns, series, note=note)


def _median(values: NDArray[np.float64], words: Callable[[float], str]) -> str:
    told = values[np.isfinite(values)]
    return f"median {words(float(np.median(told)))}" if told.size else "never told"


def _estimate_ratio(run: Run, edges_ns: Times) -> Plot:
    series = []
    for side in DIRECTIONS:
        estimate, band = run.estimates.get(side), run.bands.get(side)
        if estimate is None or band is None:
            continue
        ratio = _ratio(estimate, band, _middles(edges_ns))
        known = ratio[np.isfinite(ratio)]
        figure = f"median {np.median(known):.2f}" if known.size else ""
        series.append(_series(WAY_NAMES[side], ratio, figure, WAY_COLOURS[side]))
    note = "1 is right, above 1 fills the link's buffer"
    return _plot("Estimated over true rate", "ratio", edges_ns, series, scale="log", mark=1.0, note=note)


def _ratio(estimate: Estimate, band: Steps, t_ns: Times) -> NDArray[np.float64]:
    """NaN where nothing is estimated and while the link carries nothing."""
    estimated, true = estimate.at(estimate.rate_bps, t_ns), band.at(t_ns).astype(np.float64)
    known = (true > 0) & (estimated > 0)
    ratio = np.full(t_ns.size, np.nan)
    ratio[known] = estimated[known] / true[known]
    return ratio


def _delivered(run: Run, summary: Summary, colours: dict[str, int]) -> Plot:
    edges_ns = _edges(run.duration_ns, COUNT_BIN_NS, MAX_COUNT_BINS)
    widths_s = np.diff(edges_ns) / 1e9
    series = []
    for row in summary.topics:
        if row.topic not in run.deliveries:
            continue
        counts, _ = np.histogram(run.deliveries[row.topic].t_ns, edges_ns)
        per_s = np.where(counts > 0, counts / widths_s, np.nan)
        share = f" of {row.offered:,}" if row.offered is not None else ""
        series.append(_series(row.topic, per_s, f"{count(row.delivered)}{share}", colours[row.topic]))
    return _plot("Delivered", "/s", edges_ns, series, scale="log", note="messages per second; gaps: none")


def _figure(spread: Spread | None) -> str:
    return "" if spread is None else f"p50 {seconds(spread.p50_ns)}, p95 {seconds(spread.p95_ns)}"


def _bin_max(t_ns: Times, values: Times | NDArray[np.float64], edges_ns: Times) -> NDArray[np.float64]:
    """The greatest value within each bin, NaN where there is none."""
    bins = np.searchsorted(edges_ns, t_ns, side="right") - 1
    inside = (bins >= 0) & (bins < edges_ns.size - 1)
    worst = np.full(edges_ns.size - 1, np.nan)
    np.fmax.at(worst, bins[inside], values[inside].astype(np.float64))
    return worst


def _edges(duration_ns: int, bin_ns: int, max_bins: int) -> Times:
    bins = int(np.clip(duration_ns // bin_ns, 1, max_bins))
    return np.linspace(0, duration_ns, bins + 1).astype(np.int64)


def _middles(edges_ns: Times) -> Times:
    return (edges_ns[:-1] + edges_ns[1:]) // 2


def _plot(
    title: str,
    unit: str,
    edges_ns: Times,
    series: list[Plot],
    *,
    scale: str = "linear",
    side: str = "down",
    mark: float | None = None,
    note: str = "",
) -> Plot:
    """side: the direction whose bands shade the plot. mark: a reference line."""
    t_s = [round(float(t), 3) for t in _middles(edges_ns) / 1e9]
    return {
        "title": title, "unit": unit, "note": note, "t": t_s, "series": series,
        "scale": scale, "side": side, "mark": mark,
    }  # fmt: skip


def _series(
    name: str, values: NDArray[np.float64], figure: str, colour: int | None = None, *, shape: str = "line"
) -> Plot:
    """Four significant digits are more than a pixel tells."""
    rounded = [float(f"{value:.4g}") if np.isfinite(value) else None for value in values]
    return {"name": name, "figure": figure, "colour": colour, "shape": shape, "values": rounded}

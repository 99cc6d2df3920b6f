"""The run as one self-contained HTML page: no network, no mouse needed."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template

from .figures import count, counters_told, percent, size, spread_cells
from .plots import WAY_NAMES, band_spans, plots
from .run import Run
from .summary import Summary, TopicSummary

_YEAR_2000_NS = 946_684_800 * 1_000_000_000  # an earlier start is virtual time, not a date


def write_page(run: Run, summary: Summary, out: Path) -> Path:
    """Write the page and return its path."""
    here = files("straitlink.report")
    vendor = here / "vendor"
    counters = counters_told(summary)
    data = {"plots": plots(run, summary), "bands": band_spans(run), "duration_s": summary.duration_s}
    page = Template((here / "page.html").read_text()).substitute(
        title=escape(_title(run)),
        facts=_facts(run, summary),
        directions=_directions(summary),
        counter_names="".join(f"<th>{name}</th>" for name in counters),
        counters="".join(_counters(row, counters) for row in summary.topics),
        ages="".join(_ages(row) for row in summary.topics),
        run_json=escape(json.dumps(dict(run.facts), indent=2, default=str)),
        style=(vendor / "uPlot.min.css").read_text(),
        uplot=(vendor / "uPlot.iife.min.js").read_text(),
        data=json.dumps(data, separators=(",", ":"), allow_nan=False).replace("</", "<\\/"),
    )
    out.write_text(page, encoding="utf-8")
    return out


def _title(run: Run) -> str:
    name = run.facts.get("profile") or run.facts.get("source") or "run"
    return f"straitlink: {run.facts.get('kind', 'run')}, {name}"


def _facts(run: Run, summary: Summary) -> str:
    """The few facts that head the page; all of run.json is at its end."""
    shown = [(name, run.facts[name]) for name in ("kind", "profile", "source", "seed") if name in run.facts]
    shown.append(("duration", f"{summary.duration_s:.1f} s"))
    start_ns = run.facts.get("start_unix_ns", 0)
    if isinstance(start_ns, int) and start_ns > _YEAR_2000_NS:
        start = datetime.fromtimestamp(start_ns / 1e9, UTC)
        shown.append(("start", start.strftime("%Y-%m-%d %H:%M:%S UTC")))
    if summary.malformed_lines:
        shown.append(("malformed trace lines", summary.malformed_lines))
    return "".join(f"<div><dt>{escape(k)}</dt><dd>{escape(str(v))}</dd></div>" for k, v in shown)


def _directions(summary: Summary) -> str:
    cards = []
    for row in summary.directions:
        p50, p95, worst = spread_cells(row.queue_delay)
        capacity = f" of {size(row.capacity_bytes)}" if row.capacity_bytes is not None else ""
        loss = f"{count(row.dropped)} of {count(row.packets)} packets dropped" if row.packets else ""
        cards.append(
            f'<section class="card"><h3>{escape(WAY_NAMES[row.direction])}</h3>'
            f'<p class="big">{percent(row.utilisation)}<small> of the true rate used</small></p>'
            f"<p>{size(row.wire_bytes)}{capacity} on the wire</p>"
            f"<p>queueing delay p50 {p50}, p95 {p95}, max {worst}</p><p>{loss}</p></section>"
        )
    return "".join(cards)


def _counters(row: TopicSummary, names: Sequence[str]) -> str:
    return _row(row, [*(count(getattr(row, name)) for name in names), size(row.payload_bytes)])


def _ages(row: TopicSummary) -> str:
    spreads = (row.one_way_delay, row.age_at_delivery, row.age_of_information)
    return _row(row, [cell for spread in spreads for cell in spread_cells(spread)])


def _row(row: TopicSummary, cells: list[str]) -> str:
    arrow = "↓" if row.direction == "down" else "↑"
    numbers = "".join(f"<td>{escape(cell)}</td>" for cell in cells)
    return f'<tr><th scope="row">{arrow} {escape(row.topic)}</th>{numbers}</tr>\n'

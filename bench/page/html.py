"""The page as one HTML file with plots inside, which needs no network."""

from __future__ import annotations

import io
import math
import re
from collections.abc import Sequence
from html import escape

import matplotlib

matplotlib.use("svg")
from matplotlib import pyplot
from matplotlib.figure import Figure

from bench.page.section import INTRODUCTION, Bars, Curves, Section, Table

_OURS = "straitlink"
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 92rem; margin: 2rem auto; padding: 0 1rem;
  color: #1d2730; }
h1, h2 { line-height: 1.2; } h2 { margin-top: 3rem; border-bottom: 1px solid #d5dbe1; }
table { border-collapse: collapse; margin: 1rem 0 2rem; font-variant-numeric: tabular-nums; display: block;
  overflow-x: auto; }
caption { text-align: left; font-weight: 600; padding: .4rem 0; }
th, td { padding: .2rem .55rem; text-align: right; border-bottom: 1px solid #e6eaee; font-size: 13.5px; }
th { vertical-align: bottom; } td { white-space: nowrap; }
nav { columns: 3; }
th:first-child, td:first-child { text-align: left; }
tr.ours td { background: #eaf4ee; font-weight: 600; }
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(30rem, 1fr)); gap: 1rem; }
.plots svg { max-width: 100%; height: auto; }
.source { color: #5b6975; }
"""


def html_page(sections: Sequence[Section]) -> str:
    """The whole page."""
    body = "".join(_section(section) for section in sections)
    contents = "".join(f'<a href="#{_anchor(s)}">{escape(s.title)}</a><br>' for s in sections)
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8"><title>straitlink: benchmarks</title>'
        f"<style>{_STYLE}</style></head><body><h1>straitlink: benchmarks</h1>"
        f"{_prose(INTRODUCTION)}<nav>{contents}</nav>{body}</body></html>\n"
    )


def _section(section: Section) -> str:
    plots = "".join(f"<div>{_svg(plot)}</div>" for plot in section.plots)
    return (
        f'<h2 id="{_anchor(section)}">{escape(section.title)}</h2>{_prose(section.lead)}'
        f'<p class="source"><code>{escape(section.command)}</code>: {escape(section.provenance)}</p>'
        + (f'<div class="plots">{plots}</div>' if plots else "")
        + "".join(_table(table) for table in section.tables)
    )


def _anchor(section: Section) -> str:
    return re.sub("[^a-z0-9]+", "-", section.title.lower())


def _prose(text: str) -> str:
    """Paragraphs, lists, code and emphasis: as much of Markdown as the leads use."""
    parts = []
    for block in text.split("\n\n"):
        lines = block.split("\n")
        if all(line.startswith("- ") for line in lines):
            parts.append("<ul>" + "".join(f"<li>{_inline(line[2:])}</li>" for line in lines) + "</ul>")
        else:
            parts.append(f"<p>{_inline(block)}</p>")
    return "".join(parts)


def _inline(text: str) -> str:
    text = re.sub(r"`([^`]*)`", r"<code>\1</code>", escape(text))
    return re.sub(r"\*([^*]+)\*", r"<em>\1</em>", text)


def _table(table: Table) -> str:
    head = "".join(f"<th>{escape(cell)}</th>" for cell in table.header)
    rows = "".join(
        f"<tr{_class(row)}>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>"
        for row in table.rows
    )
    caption = f"<caption>{escape(table.caption)}</caption>" if table.caption else ""
    return f"<table>{caption}<thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"


def _class(row: Sequence[str]) -> str:
    return ' class="ours"' if row and row[0] == _OURS else ""


def _svg(plot: Bars | Curves) -> str:
    figure = _bars(plot) if isinstance(plot, Bars) else _curves(plot)
    out = io.StringIO()
    figure.savefig(out, format="svg", bbox_inches="tight")
    pyplot.close(figure)
    return out.getvalue()[out.getvalue().index("<svg") :]


def _bars(plot: Bars) -> Figure:
    figure, axes = pyplot.subplots(figsize=(6.4, 0.35 * len(plot.labels) + 1.2))
    shown = [value or 0.0 for value in plot.values]
    colours = ["#2b8a5a" if label == _OURS else "#9aa7b2" for label in plot.labels]
    axes.barh(range(len(shown)), shown, color=colours)
    for place, (value, low_high) in enumerate(zip(plot.values, plot.ranges, strict=False)):
        if value is not None and low_high is not None:
            axes.plot(low_high, (place, place), color="#1d2730", linewidth=1.2)
    for place, value in enumerate(plot.values):
        text = "none" if value is None else f" {value:,.0f}"
        low_high = plot.ranges[place] if plot.ranges else None
        end = max(value or 0.0, low_high[1] if low_high else 0.0)
        axes.text(end, place, text, va="center", fontsize=8)
    axes.set_yticks(range(len(plot.labels)), plot.labels)
    axes.invert_yaxis()
    if plot.logarithmic:
        axes.set_xscale("log")
        least = min((value for value in shown if value > 0), default=1.0)
        axes.set_xlim(left=10 ** (math.ceil(math.log10(least)) - 1))  # else the shortest bar has no length
    axes.set_xlabel(plot.unit)
    axes.set_title(plot.title, fontsize=9, loc="left")
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def _curves(plot: Curves) -> Figure:
    figure, axes = pyplot.subplots(figsize=(6.4, 3.6))
    for name, (xs, ys) in plot.lines.items():
        axes.loglog(xs, ys, marker="o", label=name)
    axes.set_xlabel(plot.x_label)
    axes.set_ylabel(plot.y_label)
    axes.set_title(plot.title, fontsize=9, loc="left")
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    return figure

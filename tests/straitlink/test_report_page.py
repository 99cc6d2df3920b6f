"""The page: one file that needs nothing else, small, and says what the summary says."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from straitlink.report import Run, summarise, write_page
from straitlink.report.run import Deliveries, Estimate, Packets, Steps, Times

S = 1_000_000_000


def run_of(
    duration_s: int, deliveries_per_s: int = 50, topics: tuple[str, ...] = ("imu", "camera/image")
) -> Run:
    """Steady deliveries on each topic, a saturated downlink whose band changes each minute."""
    rng = np.random.default_rng(1)
    t_ns = np.linspace(0, duration_s * S - 1, duration_s * deliveries_per_s).astype(np.int64)
    age_ns = rng.integers(50_000_000, 900_000_000, t_ns.size)
    minutes = np.arange(max(duration_s // 60, 1), dtype=np.int64)
    band = Steps(minutes * 60 * S, np.where(minutes % 2 == 0, 1_000_000, 100_000))
    return Run(
        facts={"kind": "mission", "profile": "trials", "seed": 1},
        duration_ns=duration_s * S,
        topics=dict.fromkeys(topics, "down"),
        deliveries={topic: Deliveries(t_ns, age_ns, age_ns, np.full(t_ns.size, 300)) for topic in topics},
        packets={
            "down": Packets(t_ns, np.full(t_ns.size, 1000), age_ns // 10, np.zeros(t_ns.size, np.bool_))
        },
        bands={"down": band},
        estimates={"down": estimate_of(minutes * 60 * S + S, band.value)},
    )


def estimate_of(t_ns: Times, rate_bps: Times) -> Estimate:
    """A second late, with a queue of 20 ms."""
    flat = np.ones(t_ns.size)
    return Estimate(t_ns, rate_bps.astype(np.float64), 2e7 * flat, 0.1 * flat, flat)


def page_of(run: Run, tmp_path: Path) -> str:
    return write_page(run, summarise(run), tmp_path / "report.html").read_text()


def data_of(page: str) -> dict[str, Any]:
    [line] = [line for line in page.splitlines() if line.startswith("const run = ")]
    data: dict[str, Any] = json.loads(line.removeprefix("const run = ").removesuffix(";"))
    return data


class Links(HTMLParser):
    """Everything that a browser would fetch."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found += [f"{tag} {name}" for name, _ in attrs if name in ("src", "href", "srcset", "data")]


def test_the_page_fetches_nothing(tmp_path: Path) -> None:
    page = page_of(run_of(60), tmp_path)
    links = Links()
    links.feed(page)
    assert links.found == []
    assert not re.search(r"@import|url\(|fetch\(|XMLHttpRequest|import\(", page)


def test_half_an_hour_stays_below_three_megabytes(tmp_path: Path) -> None:
    topics = tuple(f"topic_{number}" for number in range(12))
    page = page_of(run_of(1800, deliveries_per_s=20, topics=topics), tmp_path)
    assert len(page.encode()) < 3_000_000
    assert all(len(plot["t"]) <= 1200 for plot in data_of(page)["plots"])


def test_every_plot_is_there_with_its_unit_and_a_figure_for_those_without_a_mouse(tmp_path: Path) -> None:
    data = data_of(page_of(run_of(120), tmp_path))
    assert [(plot["title"], plot["unit"]) for plot in data["plots"]] == [
        ("Bytes on the wire, robot → operator", "kB/s"),
        ("Queueing delay", "s"),
        ("Age of information", "s"),
        ("Estimated rate, robot → operator", "bit/s"),
        ("Estimated queue, robot → operator", "s"),
        ("Confidence and loss", "ratio"),
        ("Estimated over true rate", "ratio"),
        ("Delivered", "/s"),
    ]
    for plot in data["plots"]:
        assert all(series["figure"] for series in plot["series"])
        assert all(len(series["values"]) == len(plot["t"]) for series in plot["series"])
    assert data["bands"]["down"] == [[0.0, 60.0, 1_000_000], [60.0, 120.0, 100_000]]


def test_the_estimate_stands_over_the_true_rate_and_is_late_where_it_was_late(tmp_path: Path) -> None:
    plots = {plot["title"]: plot for plot in data_of(page_of(run_of(120), tmp_path))["plots"]}
    true, estimate = plots["Estimated rate, robot → operator"]["series"]
    t_s = plots["Estimated rate, robot → operator"]["t"]
    assert (true["shape"], estimate["shape"]) == ("area", "line")
    differ_s = [t for t, a, b in zip(t_s, true["values"], estimate["values"], strict=True) if a != b]
    assert all(t < 1 or 60 <= t < 61 for t in differ_s) and len(differ_s) == 8
    met, queue = plots["Estimated queue, robot → operator"]["series"]
    assert set(queue["values"][4:]) == {0.02} and max(met["values"]) > 0.08
    assert queue["figure"] == "median 20 ms"


def test_the_plotted_bytes_are_the_bytes_of_the_summary(tmp_path: Path) -> None:
    run = run_of(120)
    plot = data_of(page_of(run, tmp_path))["plots"][0]
    width_s = 120 / len(plot["t"])
    plotted_bytes = sum(plot["series"][1]["values"]) * 1e3 * width_s
    assert plotted_bytes == pytest.approx(summarise(run).directions[0].wire_bytes, rel=1e-3)


def test_figures_stand_in_the_page_without_script(tmp_path: Path) -> None:
    page = page_of(run_of(120), tmp_path)
    table = page[: page.index("<script>")]
    assert "camera/image" in table and "6,000" in table
    assert "prefers-color-scheme: dark" in page


def test_a_topic_name_cannot_write_into_the_page(tmp_path: Path) -> None:
    hostile = "</script><img src=x onerror=alert(1)>"
    page = page_of(run_of(60, topics=(hostile,)), tmp_path)
    links = Links()
    links.feed(page)
    assert links.found == []
    assert hostile not in page
    assert any(series["name"] == hostile for plot in data_of(page)["plots"] for series in plot["series"])


def test_a_recording_without_link_traces_still_makes_a_page(tmp_path: Path) -> None:
    t_ns = np.array([0, S], np.int64)
    delivered = {"imu": Deliveries(t_ns, t_ns, np.empty(0, np.int64), t_ns)}
    run = Run({"kind": "recording", "source": "operator.mcap"}, S, {"imu": "down"}, delivered)
    data = data_of(page_of(run, tmp_path))
    assert [plot["title"] for plot in data["plots"]] == ["Age of information", "Delivered"]


def test_the_plotting_library_ships_with_its_licence() -> None:
    vendor = Path(str(__import__("straitlink.report.page", fromlist=["page"]).__file__)).parent / "vendor"
    assert "v1.6.32" in (vendor / "uPlot.iife.min.js").read_text()[:200]
    assert "MIT License" in (vendor / "uPlot.LICENSE.txt").read_text()

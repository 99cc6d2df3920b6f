"""Sections on the link: what each estimator makes of one, the shaper of the Trials, the emulator."""

from __future__ import annotations

from statistics import median

from bench.page.provenance import Document, command_text, counted, number, provenance_text
from bench.page.section import Bars, Section, Table
from bench.trials_rule import LOAD


def link_estimation(document: Document) -> Section:
    """What each estimator makes of each kind of link."""
    tables = []
    for estimator in dict.fromkeys(r["estimator"] for r in document["rows"]):
        rows = []
        for r in (r for r in document["rows"] if r["estimator"] == estimator):
            worst = r["worst"]
            rows.append(
                [
                    r["row"],
                    number(worst["utilisation"], ".1%"),
                    number(worst["p50_ms"], ".0f"),
                    number(worst["p95_ms"], ".0f"),
                    number(worst["long_ratio"], ".1%"),
                    number(worst["down_s"], ".2f"),
                    number(worst["up_s"], ".2f"),
                    number(worst["back_s"], ".2f"),
                    number(worst["payload_ratio"], ".1%"),
                    ", ".join(r["misses"]) or "none",
                ]
            )
        header = (
            "link", "used", "queue p50 ms", "p95 ms", "> 100 ms", "fall s", "rise s", "back s", "payload",
            "misses",
        )  # fmt: skip
        tables.append(Table(header, rows, estimator))
    return Section(
        "What the shaper makes of a link",
        f"An always backlogged mission of {document['minutes']:g} virtual minutes on each link, the worst of "
        "the seeds. *Used*: of the true rate, by all bytes sent. *Fall*, *rise*: seconds until the rate "
        "is right after a change. *Back*: after a blackout. *Misses*: figures outside what the row asks for. "
        "*Informed* is a yardstick: a sender that is told the truth as soon as word could come.",
        command_text(document, "python -m bench.link_estimation"),
        provenance_text(document),
        tables,
    )


def live_link(document: Document) -> Section:
    """The estimator in real processes."""
    by_rate = ", ".join(
        f"{share:.2f} at {int(rate) / 1000:g} kbit/s" for rate, share in document["cpu_by_rate"].items()
    )
    rows = [
        ["link used, both ways", f"{document['utilisation']:.1%}"],
        ["the worst ten seconds", f"{document['worst_window']:.1%}"],
        ["queueing delay p50, p95, ms", f"{document['p50_ms']:.0f}, {document['p95_ms']:.0f}"],
        ["time with a queue beyond 100 ms", f"{document['long_ratio']:.2%}"],
        ["datagrams dropped by a full buffer", str(document["tail_drops"])],
        ["CPU of the robot's shaper, of a core", by_rate],
        ["its wake-ups a second", str(document["wakeups_per_s"])],
        ["CPU of as many wake-ups that do nothing, of a core", f"{document['cpu_of_bare_wakeups']:.3f}"],
    ]
    return Section(
        f"The same with real processes: {document['profile']}",
        f"{document['minutes']:g} minutes, both directions always backlogged, presets not announced; judged "
        "from what entered the link.",
        command_text(document, "python -m bench.live_link"),
        provenance_text(document),
        [Table(("figure", "value"), rows)],
    )


def trials_rule(document: Document) -> Section:
    """The shaper of the Trials in place of ours."""
    flights = document["flights"]
    tables: list[Table] = []
    plots: list[Bars] = []
    for profile in dict.fromkeys(f["profile"] for f in flights):
        ways: dict[str, list[Document]] = {}
        for flight in flights:
            if flight["profile"] == profile:
                ways.setdefault(flight["way"], []).append(flight)
        tables.append(Table(_FLIGHT, [_flight(way, group) for way, group in ways.items()], profile))
        ages = [[f["heartbeat_p95_ms"] for f in group] for group in ways.values()]
        plots.append(
            Bars(
                f"Heartbeat's age, p95: {LOAD} over {profile}",
                list(ways),
                [median(a) for a in ages],
                "ms",
                logarithmic=True,
                ranges=[(min(a), max(a)) for a in ages],
            )
        )
    seeds = len({f["seed"] for f in flights})
    return Section(
        "What changed since the Trials",
        f"The camera's flood for {document['minutes']:g} virtual minutes with the link rule and the queues "
        "of team MIT's shaper of December 2013, with ours, and with one of each; medians of "
        f"{counted(seeds, 'seed')}. Their rule: the latency of the last packet *received* picks 950 or 95 "
        "kbit/s once a second, at most every 15 s, and after 50 s at the high rate it falls back. Their "
        "queues: a ring buffer per channel (1 for state and pictures, 10 for commands), strict priority, no "
        "time to live, nothing repeated. Their rule gets clocks that agree, and it knows both bands of the "
        "Trials beforehand; ours has neither. Their parity was always sent; here it is only while something "
        "is lost, to their advantage.",
        command_text(document, "python -m bench.trials_rule"),
        provenance_text(document),
        tables,
        plots,
    )


_FLIGHT = (
    "shaper", "heartbeats %", "age p50 ms", "p95 ms", "max ms", "joints %", "images %", "p50 ms",
    "commands %", "p95 ms", "link used", "queue p95 ms", "max ms",
)  # fmt: skip


def _flight(way: str, group: list[Document]) -> list[str]:
    def middle(name: str) -> str:
        return f"{median(f[name] for f in group):.0f}"

    def share(name: str) -> str:
        return f"{100 * median(f[name][0] / f[name][1] for f in group):.1f}"

    return [
        way,
        share("heartbeats"),
        *(middle(f"heartbeat_{figure}_ms") for figure in ("p50", "p95", "max")),
        share("joints"),
        share("images"),
        middle("image_p50_ms"),
        share("commands"),
        middle("command_p95_ms"),
        f"{median(f['utilisation'] for f in group):.1%}",
        middle("queue_p95_ms"),
        middle("queue_max_ms"),
    ]


def calibration(document: Document) -> Section:
    """What the emulator gives."""
    rows = [
        [
            f"{r['way']}, {r['profile']}",
            f"{r['rate_bps'] / 1000:.0f}",
            number(_thousandth(r["measured_rate_bps"]), ".1f"),
            f"{r['delay_ms']:.0f}",
            number(r["measured_delay_ms"], ".2f"),
            f"{r['buffer_s']:.1f}",
            number(r["measured_buffer_s"], ".3f"),
            f"{r['loss_ratio']:.0%}",
            number(r["measured_loss_ratio"], ".2%"),
        ]
        for r in document["runs"]
    ]
    header = (
        "way, link", "asked kbit/s", "got", "asked ms", "got", "asked buffer s", "got", "asked loss", "got",
    )  # fmt: skip
    return Section(
        "The emulator itself",
        "Each way of applying a link, measured from outside by the same probes: what all else rests on.",
        command_text(document, "python -m bench.calibration"),
        provenance_text(document),
        [Table(header, rows)],
    )


def _thousandth(value: float | None) -> float | None:
    return None if value is None else value / 1000

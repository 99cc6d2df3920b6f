"""Sections on perception: views, their codecs, and bytes that mean harm."""

from __future__ import annotations

from bench.page.provenance import Document, command_text, provenance_text
from bench.page.section import Section, Table


def view_codec(document: Document) -> Section:
    """Views, clouds and pictures."""
    rows = [
        [
            f"{r['product']}: {r['codec']}",
            str(r["views"]),
            f"{r['bytes']:,.0f}",
            f"{r['ratio']:.2f}",
            f"{r['encode_ms']:.1f}",
            f"{r['decode_ms']:.1f}",
            "" if r["paper_bytes"] is None else f"{r['paper_bytes']:,}",
        ]
        for r in document["rows"]
    ]
    header = ("view", "of", "bytes", "ratio", "encode ms", "decode ms", "Table 1 of the paper, B")
    return Section(
        "Views",
        "Mean bytes; the ratio is to the paper's encoding at the same fidelity; CPU of one core, medians.",
        command_text(document, "python -m bench.view_codec"),
        provenance_text(document),
        [Table(header, rows)],
    )


def perception(document: Document) -> Section:
    """The perception server's work."""
    timings = {
        "taking in a scan": document["insertion"],
        "a snapshot of the history": document["snapshot"],
        **document["views"],
    }
    rows = [
        [
            name,
            str(document["view_bytes"].get(name, "")),
            f"{t['median_ms']:.2f}",
            f"{t['p95_ms']:.2f}",
            f"{t['worst_ms']:.2f}",
            str(t["n"]),
        ]
        for name, t in timings.items()
    ]
    outcomes = ", ".join(f"{count} {what.replace('_', ' ')}" for what, count in document["budget"].items())
    return Section(
        "Views of two minutes of lidar",
        f"{document['scans']:,} scans, {document['points']:,} points in {document['history_mb']:.0f} MB of "
        f"history (the process at most {document['peak_mb']:.0f} MB); CPU of one core. Random requests with "
        f"random budgets: {outcomes}.",
        command_text(document, "python -m bench.perception"),
        provenance_text(document),
        [Table(("work", "bytes", "p50 ms", "p95 ms", "worst ms", "of"), rows)],
    )


def perception_accuracy(document: Document) -> Section:
    """Views beside the truth: the worst of the seeds."""
    views: dict[str, list[Document]] = {}
    for view in document["views"]:
        views.setdefault(view["view"], []).append(view)
    maps, solids = [], []
    for name, seeds in views.items():
        missed = f"{sum(not v['holds'] for v in seeds)} of {len(seeds)}"
        if "rmse_mm" in seeds[0]:
            worst = [max(v["rmse_mm"] for v in seeds), max(v["p95_mm"] for v in seeds)]
            beyond = max(v["beyond_100_mm"] / v["cells"] for v in seeds if v["cells"])
            edges = min(v["edges_within"] for v in seeds)
            maps.append([name, *(f"{mm:.1f}" for mm in worst), f"{beyond:.2%}", f"{edges:.1%}", missed])
        else:
            farthest, stated = max((v["farthest_mm"], v["stated_mm"]) for v in seeds)
            left_out = max(v["left_out"] for v in seeds)
            solids.append([name, f"{farthest:.1f}", f"{stated:.1f}", str(left_out), missed])
    return Section(
        "Views beside the truth",
        "The synthetic mission's scanner, each view judged by rays through the exact scene; the worst of the "
        "seeds. Cells within which the truth varies by less than 3 cm are judged by their error, the others "
        "by whether they lie between their true bounds. *Missed*: seeds whose view is not as true as it must "
        "be.",
        command_text(document, "python -m bench.perception_accuracy"),
        provenance_text(document),
        [
            Table(("map", "RMS mm", "p95 mm", "beyond 100 mm", "edges within", "missed"), maps),
            Table(("cloud or octree", "farthest mm", "stated mm", "returns left out", "missed"), solids),
        ],
    )


def perception_chain(document: Document) -> Section:
    """Asked for and got, over a link."""
    rows = [[o["request"], o["told"], f"{o['took_s']:.2f}"] for o in document["outcomes"]]
    return Section(
        "Views across a link",
        f"Requests on the operator's bus over {document['profile']}, replayed from {document['log']}: what "
        "came, and how long from asking to having it.",
        command_text(document, "python -m bench.perception_chain"),
        provenance_text(document),
        [Table(("request", "what came", "s"), rows)],
    )


def view_fuzz(document: Document) -> Section:
    """Damaged and hostile views."""
    rows = [
        [
            kind,
            f"{t['cases']:,}",
            f"{t['decoded']:,}",
            f"{t['refused']:,}",
            str(len(t["broken"])),
            f"{t['worst_ms']:.0f}",
            f"{t['worst_traced_mb']:.0f}",
        ]
        for kind, t in document["decoders"].items()
    ]
    header = ("decoder", "messages", "decoded", "refused", "anything else", "worst ms", "worst MB")
    return Section(
        "Bytes that mean harm",
        "Damaged views, and small ones that stand for much. Each is decoded or refused within a second of "
        "CPU and 64 MB.",
        command_text(document, "python -m bench.view_fuzz"),
        provenance_text(document),
        [Table(header, rows)],
    )

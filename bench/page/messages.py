"""Sections on messages: bounded ones, differences, and what the bus carries."""

from __future__ import annotations

from bench.page.provenance import Document, command_text, provenance_text
from bench.page.section import Section, Table


def codec(document: Document) -> Section:
    """Message codec."""
    rows = [
        [
            f"{c['message']}, {c['way']}",
            str(c["dccl_bytes"]),
            str(c["protobuf_bytes"]),
            f"{c['encodes_per_s']:,}",
            f"{c['encode_factor']:.1f}",
            f"{c['decodes_per_s']:,}",
            f"{c['decode_factor']:.1f}",
        ]
        for c in document["codec"]
    ]
    header = ("message", "DCCL B", "protobuf B", "encodes/s", "x C++", "decodes/s", "x C++")
    return Section(
        "Messages",
        "One core; the factor is over the C++ DCCL 4.2.0 library's own speed on the same message.",
        command_text(document, "python -m bench.codec"),
        provenance_text(document),
        [Table(header, rows)],
    )


def delta(document: Document) -> Section:
    """State streams against acknowledged messages."""
    rows = [
        [
            f"{d['motion']}, {d['form']}",
            "none" if d["reference_s"] is None else f"{d['reference_s']:g} s old",
            f"{d['loss_ratio']:.0%}",
            f"{d['mean_bytes']:.1f}",
            str(d["max_bytes"]),
            f"{d['encodes_per_s']:,}",
            f"{d['decodes_per_s']:,}",
        ]
        for d in document["delta"]
    ]
    header = ("28 joints and pose", "reference", "loss", "mean B", "max B", "encodes/s", "decodes/s")
    return Section(
        "A robot's state",
        "At 10 Hz, each message alone and as a difference against one that has arrived.",
        command_text(document, "python -m bench.delta"),
        provenance_text(document),
        [Table(header, rows)],
    )


def encodings(document: Document) -> Section:
    """Messages of a bus as bounded ones."""
    rows = [
        [
            t["topic"],
            t["message"],
            f"{t['bus_bytes']:.0f}",
            f"{t['link_bytes']:.0f}",
            f"{t['bus_bytes'] / t['link_bytes']:.1f}" if t["link_bytes"] else "-",
            f"{t['encode_us']:.0f}",
            f"{t['decode_us']:.0f}",
        ]
        for t in document["topics"]
    ]
    header = ("topic", "crosses as", "on the bus, B", "on the link, B", "ratio", "encode us", "decode us")
    return Section(
        "What the bus carries, bounded",
        "Topics of the synthetic mission in their own encodings on the bus and in the catalogue's on "
        "the link.",
        command_text(document, "python -m bench.encodings"),
        provenance_text(document),
        [Table(header, rows)],
    )

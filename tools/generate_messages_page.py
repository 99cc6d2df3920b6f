"""Write docs/messages.md from the catalogue: each message, field, bounds, unit, bits, source.

python -m tools.generate_messages_page [OUTPUT_FILE]
"""

from __future__ import annotations

import sys
from pathlib import Path

from messages.bounded_catalogue import BOUNDED_CATALOGUE, BoundedMessage
from messages.dccl import Codec, FieldInfo
from messages.payload.maps import maps_of

PAGE = Path(__file__).resolve().parent.parent / "docs" / "messages.md"

HEAD = """# The bounded messages

Written from the catalogue by `make messages-page`; do not edit. What crosses a thin link in place of what
buses carry: each field is one of the values between its bounds, and costs the bits to say which. A topic
takes one by `[encodings.NAME]` with `message = "..."` (encodings.md); the types under *Said on the bus as*
are taken and given back as they are. `straitlink messages` prints the same, `straitlink messages from-urdf`
makes such a message for any robot. Bits with a range depend on what is set. Time stamps do not cross as
fields: the link tells every message's capture time. Views and their requests: perception.md.
"""


def page() -> str:
    """The whole page."""
    sections = [_section(message) for message in BOUNDED_CATALOGUE]
    return "\n".join([HEAD, *_summary(), "", *sections])


def _summary() -> list[str]:
    lines = ["| message | bytes | class | |", "|---|---|---|---|"]
    for message in BOUNDED_CATALOGUE:
        info = Codec(message.message_type).info()
        size = _range(info.min_bytes, info.max_bytes)
        lines.append(
            f"| [{message.name}](#{_anchor(message.name)}) | {size} | {message.traffic_class} "
            f"| {message.purpose} |"
        )
    return lines


def _section(message: BoundedMessage) -> str:
    info = Codec(message.message_type).info()
    lines = [
        f"## {message.name}",
        "",
        f"Id {info.message_id}, {_range(info.min_bytes, info.max_bytes)} bytes: {message.purpose}.",
        "",
    ]
    types = [f"`{m.bus_type}`" for m in maps_of(message.message_type)]
    own = f"`application/protobuf;{message.name}`"
    said = list(dict.fromkeys((own, *types)))
    alone = "" if len(said) > 1 else " Neither ROS 2 nor Foxglove has a type that says this."
    lines += [f"Said on the bus as {', '.join(said)}.{alone}", ""]
    lines += [
        "| field | type | bounds | resolution | unit | bits | source |",
        "|---|---|---|---|---|---|---|",
    ]
    lines += [_row(row) for row in info.fields]
    return "\n".join([*lines, ""])


def _row(row: FieldInfo) -> str:
    bounds = "" if row.minimum is None else f"{row.minimum:.10g} .. {row.maximum:.10g}"
    resolution = "" if row.resolution is None else f"{row.resolution:.10g}"
    cells = (
        f"`{row.path}`",
        row.type_name,
        bounds,
        resolution,
        row.unit,
        _range(row.min_bits, row.max_bits),
        row.description,
    )
    return f"| {' | '.join(cells)} |"


def _range(low: int, high: int) -> str:
    return str(low) if low == high else f"{low} to {high}"


def _anchor(name: str) -> str:
    return name.lower().replace(".", "")


if __name__ == "__main__":
    Path(sys.argv[1] if len(sys.argv) > 1 else PAGE).write_text(page())

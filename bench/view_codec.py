"""What every codec makes of every view: `python -m bench.view_codec`.

Bytes, ratio to the paper's encoding at the same fidelity, and CPU time of one core (the best of several
rounds of each view, the median over views), beside Table 1 of the paper. Views: a suite of real ones where
`../shared/data/views/suite.npz` is there, else blocks and walls of our own. A product is added by a function
that returns rows, named in PRODUCTS.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bench.machine import provenance
from bench.view_images import image_rows
from bench.view_overview import overview_rows
from bench.view_points import cloud_rows, octree_rows
from bench.view_rows import Coded, Row, coded, row
from perception_server.view_codec import decode_map, encode_map, warm_up

OUT = Path("out/bench/view_codec.json")
SUITE = Path("../shared/data/views/suite.npz")
MAP_CODECS = ("zlib", "serpentine", "context")
MAP_KINDS = {"hm": "height map", "rm": "range map"}
FIDELITIES: dict[str, dict[str, Any]] = {
    "8 bit": {"bits": 8},
    "10 mm": {"max_error_m": 0.010},
    "5 mm": {"max_error_m": 0.005},
    "1 mm": {"max_error_m": 0.001},
}
HEADER = ("product", "codec", "views", "bytes", "ratio", "encode ms", "decode ms", "paper bytes", "p95 mm")
COLOURS = ("#8a8f98", "#4c78a8", "#e4572e", "#54a24b")


def own_maps() -> dict[str, list[NDArray[np.float32]]]:
    """Blocks on a slope under scan lines, and a room as a structured-light sensor gives it."""
    source = np.random.default_rng(1)
    y, x = np.mgrid[:133, :200].astype(np.float64)
    heights = 0.2 * ((x // 13 * 7 + y // 13 * 5) % 4 == 1) + 0.002 * x - 0.9
    heights += source.normal(0, 0.008, x.shape)
    heights[np.hypot(x - 10, y - 66) % (1 + x / 50) > 1.2] = np.nan
    y, x = np.mgrid[:200, :200].astype(np.float64)
    ball = 90 * (np.hypot(x - 90, y - 120) < 40)
    disparity = np.round(150 + 0.3 * x + ball + source.normal(0, 0.3, x.shape))
    return {"hm": [heights.astype(np.float32)], "rm": [(580 / disparity).astype(np.float32)]}


def maps() -> dict[str, list[NDArray[np.float32]]]:
    """Height maps (hm) and range maps (rm), float32 metres, NaN in holes."""
    if not SUITE.exists():
        return own_maps()
    suite = np.load(SUITE)
    return {kind: [suite[name] for name in suite if f"|{kind}|" in name] for kind in MAP_KINDS}


def map_rows() -> Iterator[Row]:
    """Maps at four fidelities, and the overview: 10 mm, denoised, gaps closed."""
    warm_up()
    for kind, views in maps().items():
        for fidelity, wish in FIDELITIES.items():
            product = f"{MAP_KINDS[kind]}, {fidelity}"
            paper: list[Coded] = []
            for codec in MAP_CODECS:
                encode = partial(encode_map, codec=codec, **wish)
                done = [coded(view, encode, decode_map) for view in views]
                paper = paper or done
                yield row(product, codec, done, paper)
        encode = partial(encode_map, max_error_m=0.01, denoise=True, close_gaps=True)
        raw = [coded(view, partial(encode_map, max_error_m=0.01, codec="zlib"), decode_map) for view in views]
        overview = [coded(view, encode, decode_map) for view in views]
        yield row(f"{MAP_KINDS[kind]} overview", "context", overview, raw)


PRODUCTS: tuple[Callable[[], Iterator[Row]], ...] = (
    map_rows,
    overview_rows,
    cloud_rows,
    octree_rows,
    image_rows,
)


def table(rows: list[Row]) -> str:
    """The rows as text."""
    lines = [f"{HEADER[0]:28}{HEADER[1]:12}" + "".join(f"{name:>12}" for name in HEADER[2:])]
    for r in rows:
        paper = "" if r.paper_bytes is None else f"{r.paper_bytes:,}"
        off = "" if r.p95_mm is None else f"{r.p95_mm:.1f}"
        lines.append(
            f"{r.product:28}{r.codec:12}{r.views:12}{r.bytes:12,.0f}{r.ratio:12.3f}"
            f"{r.encode_ms:12.1f}{r.decode_ms:12.1f}{paper:>12}{off:>12}"
        )
    return "\n".join(lines)


def picture(rows: list[Row]) -> str:
    """An SVG of bytes: a group of bars for each product, a bar for each codec, a line for the paper's."""
    groups: dict[str, list[Row]] = {}
    for r in rows:
        groups.setdefault(r.product, []).append(r)
    most = max(max(r.bytes, r.paper_bytes or 0) for r in rows)
    codecs = list(dict.fromkeys(r.codec for r in rows))
    parts, y = [], 40
    for product, group in groups.items():
        parts.append(f'<text x="208" y="{y + 8 * len(group)}" text-anchor="end">{product}</text>')
        for r in group:
            width = 560 * r.bytes / most
            colour = COLOURS[codecs.index(r.codec) % len(COLOURS)]
            parts.append(f'<rect x="216" y="{y}" width="{width:.1f}" height="12" fill="{colour}"/>')
            parts.append(f'<text x="{220 + width:.1f}" y="{y + 10}">{r.bytes:,.0f} (x{r.ratio:.2f})</text>')
            y += 14
        if group[0].paper_bytes:
            x = 216 + 560 * group[0].paper_bytes / most
            parts.append(f'<path d="M{x:.1f} {y - 14 * len(group) - 3}V{y + 1}" stroke="black"/>')
        y += 10
    for i, codec in enumerate(codecs):
        colour = COLOURS[i % len(COLOURS)]
        parts.append(f'<rect x="{216 + 120 * i}" y="12" width="12" height="12" fill="{colour}"/>')
        parts.append(f'<text x="{232 + 120 * i}" y="22">{codec}</text>')
    parts.append(f'<text x="{216 + 120 * len(codecs)}" y="22">| the paper\'s Table 1; bytes, mean</text>')
    style = 'font-family="sans-serif" font-size="11"'
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="900" height="{y}" {style}>\n'
        + "\n".join(parts)
        + "\n</svg>\n"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Every view codec on every product, beside the paper's.")
    parser.add_argument("--json", action="store_true", help="print the rows as JSON")
    parser.add_argument("--out", type=Path, default=OUT, help="where the JSON goes; the plot beside it")
    arguments = parser.parse_args()
    rows = [r for product in PRODUCTS for r in product()]
    document = {**provenance(), "rows": [asdict(r) for r in rows]}
    arguments.out.parent.mkdir(parents=True, exist_ok=True)
    arguments.out.write_text(json.dumps(document, indent=2) + "\n")
    plot = arguments.out.with_suffix(".svg")
    plot.write_text(picture(rows))
    print(json.dumps(document, indent=2) if arguments.json else f"{table(rows)}\n\n{plot}")


if __name__ == "__main__":
    main()

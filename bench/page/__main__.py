"""Write docs/benchmarks.md and out/bench/index.html from the results that are there."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from bench.page.html import html_page
from bench.page.markdown import markdown_page
from bench.page.sections import SECTIONS

FOLDER = Path("out/bench")
DOCS = Path("docs/benchmarks.md")


def main() -> None:
    """Results that are not there are named, and their sections left out."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--docs", action="store_true", help="write docs/benchmarks.md too")
    a = parser.parse_args()
    sections = []
    for name, make in SECTIONS.items():
        path = FOLDER / f"{name}.json"
        if not path.exists():
            print(f"{path} is not there: its section is left out")
            continue
        try:
            sections.append(make(json.loads(path.read_text())))
        except (KeyError, TypeError) as error:
            print(f"{path} is of another version of its bench ({error!r}): its section is left out")
    page = FOLDER / "index.html"
    page.write_text(html_page(sections))
    print(f"wrote {page}")
    if a.docs:
        DOCS.write_text(markdown_page(sections))
        print(f"wrote {DOCS}")


if __name__ == "__main__":
    main()

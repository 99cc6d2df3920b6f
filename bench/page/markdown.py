"""The page as Markdown, for docs/benchmarks.md."""

from __future__ import annotations

from collections.abc import Sequence

from bench.page.section import INTRODUCTION, Section, Table

_HEAD = """# Benchmarks

"""
_MADE = "Made by `python -m bench.page --docs` from what the commands below left under `out/bench`.\n"


def markdown_page(sections: Sequence[Section]) -> str:
    """The whole of docs/benchmarks.md."""
    return _HEAD + f"{INTRODUCTION}\n\n{_MADE}" + "".join(f"\n{_section(section)}" for section in sections)


def _section(section: Section) -> str:
    tables = "\n".join(_table(table) for table in section.tables)
    return f"## {section.title}\n\n{section.lead}\n\n`{section.command}`: {section.provenance}\n\n{tables}"


def _table(table: Table) -> str:
    caption = f"**{table.caption}**\n\n" if table.caption else ""
    lines = [_line(table.header), "|---" + "|---:" * (len(table.header) - 1) + "|"]
    lines += [_line(row) for row in table.rows]
    return caption + "\n".join(lines) + "\n"


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"

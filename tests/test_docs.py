"""What the documentation says of the code is true."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from shaper.config_tables import TABLES, ShaperTable
from shaper.frames import HEADER_BYTES, IP_UDP_BYTES
from shaper.incoming import Limits
from shaper.traffic_class import DEFAULT_CLASSES
from straitlink.cli import app
from tools.generate_messages_page import page

DOCS = Path(__file__).resolve().parent.parent / "docs"
README = DOCS.parent / "README.md"


def rows(text: str) -> list[list[str]]:
    """The cells of every line of a Markdown table."""
    return [
        [cell.strip() for cell in line.strip("|").split(" | ")]
        for line in text.splitlines()
        if line.startswith("|")
    ]


def test_the_table_of_classes_is_that_of_the_code() -> None:
    told = {
        cells[0].strip("`"): cells
        for cells in rows((DOCS / "configuration.md").read_text())
        if len(cells) >= 4
    }
    for name, traffic_class in DEFAULT_CLASSES.items():
        _, tier, keep, ttl, *_ = told[name]
        assert tier == str(traffic_class.tier), name
        assert keep.split(",")[0] == traffic_class.keep.value, name
        assert ttl == "" or ttl == f"{traffic_class.ttl_ns / 1e9:g} s", name


def test_every_key_of_the_configuration_is_described() -> None:
    text = (DOCS / "configuration.md").read_text()
    for table in (*TABLES.values(), ShaperTable):
        for field, info in table.model_fields.items():
            name = info.alias or field
            assert (
                f"`{name}`" in text
                or f"[{name}" in text
                or f".{name}]" in text
                or name in ("key", "field", "ignored", "ignored_outside")
            ), name


def test_the_limits_are_those_of_the_code() -> None:
    text = (DOCS / "configuration.md").read_text()
    limits = Limits()
    for value in (limits.max_message_bytes, limits.max_reassembly_bytes):
        assert f"{value:,}" in text
    assert f"| {limits.max_topics} |" in text


def test_the_sizes_on_the_wire_are_those_of_the_code() -> None:
    text = (DOCS / "wire_format.md").read_text()
    assert f"a header of {HEADER_BYTES} bytes" in text
    assert f"take {IP_UDP_BYTES} (IP, UDP)" in text.replace("takes", "take")


def test_the_page_of_messages_is_that_of_the_catalogue() -> None:
    assert (DOCS / "messages.md").read_text() == page(), "run `make messages-page`"


def test_every_command_is_in_the_readme() -> None:
    told = set(re.findall(r"`straitlink ([a-z]+)", README.read_text()))
    commands = {command.callback.__name__ for command in app.registered_commands if command.callback}
    assert commands <= told


@pytest.mark.parametrize("page", [README, *DOCS.glob("*.md")], ids=lambda page: page.name)
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#: ]+)\)", page.read_text()):
        assert (page.parent / target).exists(), target

"""The terminal that results are printed on."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import Console

_TABLE_COLUMNS = 110  # what the widest table needs; a narrower terminal wraps rather than cuts figures


def wide_console() -> Console:
    """Standard output, wide enough for every table."""
    from rich.console import Console

    console = Console()
    console.width = max(console.width, _TABLE_COLUMNS)
    return console

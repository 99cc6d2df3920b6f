"""The `straitlink` command: composition only, every command's work lives in its own module."""

from __future__ import annotations

import typer

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)


@app.callback()
def straitlink() -> None:
    """Operate robots over links that are thin, slow, changing and broken."""


def main() -> None:
    """Entry point of the console script."""
    app()

"""`straitlink messages`: what each message costs, field by field."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer()


@app.command()
def messages(
    proto: Annotated[list[Path], typer.Option(help="A .proto file with DCCL bounds; may be repeated.")] = [],  # noqa: B006 (typer reads the default, nobody changes it)
    include: Annotated[list[Path], typer.Option("--include", "-I", help="Folder that it imports from.")] = [],  # noqa: B006
    as_json: Annotated[bool, typer.Option("--json", help="Print sizes as JSON.")] = False,
) -> None:
    """Print the topics of the catalogue, or the bit budget of each DCCL message in .proto files."""
    if proto:
        _print_budgets(proto, include, as_json)
    else:
        _print_catalogue(as_json)


def _print_budgets(protos: list[Path], folders: list[Path], as_json: bool) -> None:
    from messages.dccl import Codec, load_proto, sendable_types

    sizes = {}
    for path in protos:
        for message_type in sendable_types(load_proto(path, folders)).values():
            info = Codec(message_type).info()
            sizes[message_type.DESCRIPTOR.full_name] = {
                "min_bytes": info.min_bytes,
                "max_bytes": info.max_bytes,
            }
            if not as_json:
                typer.echo(f"{info}\n")
    if as_json:
        typer.echo(json.dumps(sizes, indent=1))


def _print_catalogue(as_json: bool) -> None:
    from rich.box import SIMPLE
    from rich.table import Table

    from messages.catalogue import CATALOGUE
    from straitlink.commands.console import wide_console

    if as_json:
        rows = [
            {
                "key": t.key,
                "schema": t.schema_name,
                "direction": t.direction,
                "rate_hz": t.rate_hz,
                "class": t.traffic_class,
            }
            for t in CATALOGUE
        ]
        typer.echo(json.dumps(rows, indent=1))
        return
    table = Table(box=SIMPLE, padding=0, pad_edge=False)
    for heading in ("topic", "schema", "way", "Hz", "class"):
        table.add_column(heading, no_wrap=True)
    for t in CATALOGUE:
        table.add_row(t.key, t.schema_name, t.direction, f"{t.rate_hz:.3g}", t.traffic_class)
    wide_console().print(table)

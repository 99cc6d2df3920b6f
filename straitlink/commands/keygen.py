"""`straitlink keygen`: the key that the two ends of a link share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer()


@app.command()
def keygen(
    file: Annotated[Path, typer.Argument(help="Where to write the key; it must not exist yet.")],
) -> None:
    """Make a link key in a file that only you can read.

    Copy the file to the other side by a way that you trust (scp), and name it in link.keys of both. To change
    keys without an outage: add the new file at the end of link.keys on both sides, then put it first on both,
    then take the old one out; each step may be done on one side after the other.
    """
    import secrets

    from shaper.key_file import write_key_file
    from shaper.link_key import make_link_key

    key = make_link_key(secrets.token_bytes)
    write_key_file(file, key)
    typer.echo(f"{file}: link key {key.name}, readable by you only; copy it to the other side")

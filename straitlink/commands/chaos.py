"""`straitlink chaos`: both shapers against everything that can happen to them, in virtual time."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Annotated

import typer

from straitlink.commands.progress import progress_bar

app = typer.Typer()


@app.command()
def chaos(
    seed: Annotated[int, typer.Option(help="Of the first mission; same seed, same bytes.")] = 1,
    count: Annotated[
        int, typer.Option(min=1, max=1_000_000, help="Missions, of one seed after the other.")
    ] = 1,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON line per mission.")] = False,
) -> None:
    """Kill, move, cut and deceive both shapers for 40 s, then ask whether every message has its outcome.

    Checked at every step: no reliable message twice or out of order, memory bounded, ledgers balanced; at
    the end: each one delivered or reported, both directions carry. Exit code 1 if anything is broken.
    """
    from straitlink.chaos import ChaosError, run_chaos

    broken = kills = offered = delivered = 0
    with progress_bar("chaos", hidden=as_json or count == 1) as on_progress:
        for each in range(seed, seed + count):
            try:
                report = run_chaos(each)
            except ChaosError as error:
                broken += 1
                typer.echo(json.dumps({"seed": each, "broken": str(error)}) if as_json else str(error))
                continue
            finally:
                on_progress((each - seed + 1) / count)
            kills, offered = kills + report.kills, offered + report.offered
            delivered += report.delivered
            if as_json:
                typer.echo(json.dumps(asdict(report)))
    if not as_json:
        typer.echo(
            f"{count} missions, {broken} broken: {kills} kills, {offered} reliable messages, "
            f"{delivered} delivered once, {offered - delivered} reported lost or expired"
        )
    if broken:
        raise typer.Exit(1)

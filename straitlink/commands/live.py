"""`straitlink shaper` and `bus`: the parts that run until they are stopped."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer()


@app.command()
def shaper(
    config: Annotated[Path, typer.Argument(help="TOML file; examples/robot.toml shows one.")],
    trace: Annotated[Path | None, typer.Option(help="Write events as JSON lines to this file.")] = None,
) -> None:
    """Carry this host's topics over the link, until SIGTERM or Ctrl-C."""
    import asyncio
    import logging

    from shaper.config import load_config
    from shaper.doorstep import Doorstep
    from straitlink.processes import run_until_signal

    logging.basicConfig(level=logging.INFO, format="shaper: %(message)s")
    settings = load_config(config)
    door = Doorstep(settings)  # refuses a key that others can read before anything is said
    listen, peer = (f"{host}:{port}" for host, port in (settings.listen, settings.peer))
    typer.echo(f"shaper: {settings.side} side on {listen}, peer {peer}", err=True)

    async def run(stop: asyncio.Event) -> None:
        with door:
            await door.step()
            from shaper.daemon import Daemon  # takes a while to load: the answer comes meanwhile

            await Daemon(settings, door, trace).run(stop)

    run_until_signal(run)


@app.command()
def bus(
    listen: Annotated[list[str], typer.Option("--listen", "-l", help="Zenoh endpoint, tcp/127.0.0.1:7447.")],
) -> None:
    """Run a Zenoh router for one host's bus: no scouting, no shared memory; until SIGTERM or Ctrl-C."""
    import asyncio

    from shaper.bus import BusSettings, open_bus
    from straitlink.processes import run_until_signal

    async def serve(stop: asyncio.Event) -> None:
        session = open_bus(BusSettings(listen=listen))
        typer.echo(f"bus: open on {', '.join(listen)}", err=True)
        try:
            await stop.wait()
        finally:
            session.close()

    run_until_signal(serve)

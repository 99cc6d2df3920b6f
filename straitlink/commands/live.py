"""`straitlink shaper`, `link` and `bus`: the parts that run until they are stopped."""

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
    from shaper.config import load_config
    from shaper.daemon import Daemon
    from straitlink.processes import run_until_signal

    settings = load_config(config)
    listen, peer = (f"{host}:{port}" for host, port in (settings.listen, settings.peer))
    typer.echo(f"shaper: {settings.side} side on {listen}, peer {peer}", err=True)
    run_until_signal(Daemon(settings, trace).run)


@app.command()
def link(
    profile: Annotated[str, typer.Option(help="Name of a link profile, or a TOML file.")] = "trials",
    robot_side: Annotated[str, typer.Option(help="Where the robot's shaper sends to.")] = "127.0.0.1:9101",
    operator_side: Annotated[str, typer.Option(help="Where the operator's sends to.")] = "127.0.0.1:9102",
    robot_peer: Annotated[str, typer.Option(help="Where the robot's shaper listens.")] = "127.0.0.1:9001",
    operator_peer: Annotated[str, typer.Option(help="Where the operator's listens.")] = "127.0.0.1:9002",
    seed: Annotated[int, typer.Option(help="Of loss, jitter and duplication.")] = 1,
    trace: Annotated[Path | None, typer.Option(help="Write each packet's fate as JSON lines.")] = None,
    list_profiles: Annotated[bool, typer.Option("--list", help="Print the profiles and stop.")] = False,
) -> None:
    """Emulate the link between two UDP ports, until SIGTERM or Ctrl-C."""
    from netem_scripts.profiles import load_profile, profile_names
    from netem_scripts.udp_proxy import ProxySettings
    from straitlink.processes import run_link, run_until_signal

    if list_profiles:
        for name in profile_names():
            typer.echo(name)
        return
    settings = ProxySettings(
        load_profile(profile), robot_side, operator_side, robot_peer, operator_peer, seed
    )
    typer.echo(f"link: {profile} between {robot_side} and {operator_side}", err=True)
    report = run_until_signal(lambda stop: run_link(settings, trace, stop))
    for direction, counts in (("down", report.down), ("up", report.up)):
        typer.echo(f"link: {direction} {counts}", err=True)


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

"""`straitlink perception` and `request`: views of what the robot's sensors see, and asking for them."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer()


@app.command()
def perception(
    config: Annotated[Path, typer.Argument(help="TOML file; examples/perception.toml shows one.")],
) -> None:
    """Keep what the robot's sensors saw and serve views of it, until SIGTERM or Ctrl-C."""
    from straitlink.commands.recordings import stop_on_signals
    from straitlink.perception_config import load_perception_config
    from straitlink.perception_host import serve_views

    settings = load_perception_config(config)

    def say_open() -> None:
        counts = f"{len(settings.inputs)} inputs, {len(settings.streams)} views"
        typer.echo(f"perception: open, {counts}", err=True)

    def say(line: str) -> None:
        typer.echo(f"perception: {line}", err=True)

    for what, count in serve_views(settings, stop_on_signals(), say_open, say).items():
        typer.echo(f"perception: {what}: {count}", err=True)


@app.command()
def request(
    what: Annotated[
        list[str],
        typer.Argument(
            help="A preset (head_low, height_map_scene, ...), or image or view; then field=value pairs: "
            "quality=40 source=head chips=300,200,160,120."
        ),
    ],
    connect: Annotated[list[str], typer.Option("--connect", "-e", help="Zenoh endpoint of this host's bus.")],
    save: Annotated[
        list[Path] | None, typer.Option(help=".png, .jpg, .npz or .ply; may be given several times.")
    ] = None,
    prefix: Annotated[str, typer.Option(help="Of the server's view keys.")] = "robot/view",
    timeout: Annotated[float, typer.Option(min=0.1, max=3600, help="Seconds.")] = 60.0,
) -> None:
    """Request one view, from the robot's bus or over the link from the operator's, and save it."""
    from shaper.bus import BusSettings
    from straitlink.request_client import RequestSettings, request_view
    from straitlink.request_words import request_of
    from straitlink.saved_view import describe, save_view

    settings = RequestSettings(BusSettings(connect=connect), prefix=prefix, timeout_s=timeout)
    reply, took_s = request_view(request_of(what), settings, lambda line: typer.echo(line, err=True))
    typer.echo(f"{describe(reply)}, after {took_s:.2f} s")
    notice = "decoding: what reads views is compiled first, once on this machine, up to a minute"
    slow = threading.Timer(2.0, typer.echo, (notice,), {"err": True})
    slow.daemon = True
    slow.start()
    try:
        for path in save or []:
            save_view(reply, path)
            typer.echo(f"saved: {path}")
    finally:
        slow.cancel()


@app.command()
def views(
    connect: Annotated[list[str], typer.Option("--connect", "-e", help="Zenoh endpoint of this host's bus.")],
    prefix: Annotated[str, typer.Option(help="Of the server's view keys.")] = "robot/view",
    to: Annotated[str, typer.Option(help="Prefix of what is published.")] = "decoded",
) -> None:
    """On the operator's host: publish arriving views as Foxglove images, grids and clouds, until Ctrl-C."""
    from shaper.bus import BusSettings
    from straitlink.commands.recordings import stop_on_signals
    from straitlink.view_host import ViewHostSettings, show_views

    settings = ViewHostSettings(BusSettings(connect=connect), prefix, to, stop_on_signals())
    counts = show_views(
        settings,
        lambda: typer.echo(f"views: open, {prefix}/** as {to}/**", err=True),
        lambda line: typer.echo(f"views: {line}", err=True),
    )
    for what, count in counts.items():
        if count:
            typer.echo(f"views: {what}: {count}", err=True)

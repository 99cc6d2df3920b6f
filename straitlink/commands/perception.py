"""`straitlink perception`: the robot's pictures, made small enough to cross."""

from __future__ import annotations

from typing import Annotated

import typer

app = typer.Typer()


@app.command()
def perception(
    source: Annotated[
        list[str], typer.Argument(help="Keys of camera topics, such as robot/head_camera/image.")
    ],
    connect: Annotated[list[str], typer.Option("--connect", "-e", help="Zenoh endpoint of the robot's bus.")],
    period: Annotated[float, typer.Option(min=0.02, max=3600, help="Seconds between overviews.")] = 1.0,
    width: Annotated[int, typer.Option(help="Pixels.")] = 256,
    height: Annotated[int, typer.Option(help="Pixels.")] = 136,
    quality: Annotated[int, typer.Option(help="JPEG quality, 1 to 100.")] = 50,
) -> None:
    """Publish a small overview of each camera topic (A/image as A/overview), until Ctrl-C."""
    from perception_server.overview import Overview
    from shaper.bus import BusSettings
    from straitlink.commands.recordings import stop_on_signals
    from straitlink.overviews import OverviewSettings, publish_overviews

    settings = OverviewSettings(
        BusSettings(connect=connect), source, Overview(width, height, quality), period, stop_on_signals()
    )
    for key, refused in publish_overviews(settings).items():
        if refused:
            typer.echo(f"perception: {refused} messages on {key} were no picture", err=True)

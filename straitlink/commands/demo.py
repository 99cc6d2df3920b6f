"""`straitlink demo`: the main job on one machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from straitlink.commands.console import wide_console
from straitlink.commands.progress import progress_bar

app = typer.Typer()


@app.command()
def demo(
    log: Annotated[Path | None, typer.Option(help="MCAP file; the synthetic mission unless given.")] = None,
    profile: Annotated[str, typer.Option(help="Name of a link profile, or a TOML file.")] = "trials",
    seconds: Annotated[float, typer.Option(min=5, max=86_400, help="How long the mission lasts.")] = 150.0,
    seed: Annotated[int, typer.Option(help="Of the synthetic mission and of the link.")] = 1,
    robot: Annotated[
        Path | None,
        typer.Option(help="The robot's shaper configuration; addresses, keys, bands are replaced."),
    ] = None,
    operator: Annotated[Path | None, typer.Option(help="The same of the operator's shaper.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for the recording and the report.")] = Path("out/demo"),
) -> None:
    """Run buses, shapers, link and a mission on this machine, record the operator's side and report."""
    from rich.console import Console

    from straitlink.demo import DemoSettings, OwnConfigs, run_demo
    from straitlink.report import print_table
    from straitlink.synthetic import SyntheticSettings, synthesize

    def write_mission(path: Path) -> None:
        with progress_bar("synthetic mission") as on_progress:
            synthesize(path, SyntheticSettings(duration_s=60.0, seed=seed), on_progress)

    own = OwnConfigs(robot, operator)
    result = run_demo(DemoSettings(out, log, profile, seconds, seed, own), write_mission, Console())
    print_table(result.summary, wide_console())
    if result.interrupted:
        typer.echo("stopped early; what was recorded until then is complete")
    typer.echo(f"recording: {result.recording}")
    typer.echo(f"report:    {result.page}")

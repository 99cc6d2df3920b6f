"""The `straitlink` command: options in, one line per error out; the work lives in the modules.

Heavy imports (Zenoh, OpenCV, numpy) wait inside the commands, so that `--help` is quick.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Annotated, Any

import typer

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)

EXIT_USAGE = 2  # a setting or an address that cannot be; one line says which


@app.callback()
def straitlink() -> None:
    """Operate robots over links that are thin, slow, changing and broken."""


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
    typer.echo(
        f"shaper: {settings.side} side, {settings.listen[0]}:{settings.listen[1]} to "
        f"{settings.peer[0]}:{settings.peer[1]}, {len(settings.endpoint.rules)} topic rules",
        err=True,
    )
    run_until_signal(Daemon(settings, trace).run)


@app.command()
def link(
    profile: Annotated[str, typer.Option(help="Name of a link profile, or a TOML file.")] = "trials",
    robot_side: Annotated[
        str, typer.Option(help="host:port that the robot's shaper sends to.")
    ] = "127.0.0.1:9101",
    operator_side: Annotated[
        str, typer.Option(help="host:port that the operator's shaper sends to.")
    ] = "127.0.0.1:9102",
    robot_peer: Annotated[str, typer.Option(help="Where the robot's shaper listens.")] = "127.0.0.1:9001",
    operator_peer: Annotated[
        str, typer.Option(help="Where the operator's shaper listens.")
    ] = "127.0.0.1:9002",
    seed: Annotated[int, typer.Option(help="Of loss, jitter and duplication.")] = 1,
    trace: Annotated[Path | None, typer.Option(help="Write each packet's fate as JSON lines.")] = None,
    list_: Annotated[bool, typer.Option("--list", help="Print the profiles and stop.")] = False,
) -> None:
    """Emulate the link between two UDP ports, until SIGTERM or Ctrl-C."""
    from netem_scripts.profiles import load_profile, profile_names
    from netem_scripts.udp_proxy import ProxySettings
    from straitlink.processes import run_link, run_until_signal

    if list_:
        for name in profile_names():
            typer.echo(name)
        return
    settings = ProxySettings(
        load_profile(profile), robot_side, operator_side, robot_peer, operator_peer, seed
    )
    typer.echo(f"link: {profile}, {robot_side} <-> {operator_side}", err=True)
    run_until_signal(lambda stop: run_link(settings, trace, stop))


@app.command()
def mission(
    profile: Annotated[str, typer.Option(help="Name of a link profile, or a TOML file.")] = "trials",
    load: Annotated[
        str, typer.Option(help="Name of a load (light, full, camera-flood), or a TOML file.")
    ] = "light",
    minutes: Annotated[float, typer.Option(min=0.01, max=100_000, help="Virtual time.")] = 30.0,
    seed: Annotated[int, typer.Option(help="Same seed, same result to the byte.")] = 1,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
    out: Annotated[
        Path | None, typer.Option(help="Folder for traces that `straitlink report` reads.")
    ] = None,
) -> None:
    """Run both shapers, the link and the traffic in virtual time, without waiting."""
    from netem_scripts.profiles import load_profile
    from straitlink.mission import MissionSettings, load_named_or_file
    from straitlink.mission.output import print_result, run_and_save

    settings = MissionSettings(load_profile(profile), load_named_or_file(load), round(minutes * 60e9), seed)
    started_s = time.perf_counter()
    with progress_bar(f"mission {profile}", hidden=as_json) as on_progress:
        result = run_and_save(settings, out, on_progress)
    result["wall_s"] = round(time.perf_counter() - started_s, 3)
    if as_json:
        typer.echo(json.dumps(result, indent=1))
    else:
        print_result(result)


@app.command()
def synthesize(
    out: Annotated[Path, typer.Option(help="The MCAP file to write.")] = Path("mission.mcap"),
    seconds: Annotated[float, typer.Option(min=0.1, max=36_000)] = 60.0,
    seed: Annotated[int, typer.Option(help="Same seed and settings, same file to the byte.")] = 1,
    light: Annotated[bool, typer.Option("--light", help="Small pictures and low rates, for tests.")] = False,
    texture: Annotated[str, typer.Option(help="busy (an outdoor scene) or indoor.")] = "busy",
) -> None:
    """Write the synthetic robot mission as an MCAP log."""
    from straitlink.synthetic import SyntheticSettings, synthesize

    settings = SyntheticSettings(duration_s=seconds, seed=seed, light=light, texture=texture)  # type: ignore[arg-type]
    with progress_bar("synthesize") as on_progress:
        summary = synthesize(out, settings, on_progress)
    typer.echo(f"{out}: {summary}")


def progress_bar(title: str, *, hidden: bool = False) -> Any:
    """A progress bar on standard error; the context's value takes fractions from 0 to 1."""
    from contextlib import contextmanager

    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    @contextmanager
    def bar() -> Any:
        console = Console(stderr=True)
        columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
        with Progress(*columns, console=console, disable=hidden or not console.is_terminal) as progress:
            task = progress.add_task(title, total=1.0)
            yield lambda fraction: progress.update(task, completed=fraction)

    return bar()


def main() -> None:
    """Entry point of the console script: our errors end in their one line and exit code 2."""
    from straitlink.errors import user_errors

    try:
        app()
    except user_errors() as error:
        typer.echo(f"straitlink: {error}", err=True)
        sys.exit(EXIT_USAGE)

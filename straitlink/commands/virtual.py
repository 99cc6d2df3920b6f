"""`straitlink mission` and `straitlink synthesize`: everything that needs no clock."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Annotated, Literal

import typer

from straitlink.commands.console import wide_console
from straitlink.commands.progress import progress_bar

app = typer.Typer()


@app.command()
def mission(
    profile: Annotated[str, typer.Option(help="Name of a link profile, or a TOML file.")] = "trials",
    load: Annotated[
        str, typer.Option(help="light, full, camera-flood, backlogged, finals, or a TOML file.")
    ] = "light",
    minutes: Annotated[float, typer.Option(min=0.01, max=100_000, help="Virtual time.")] = 30.0,
    seed: Annotated[int, typer.Option(help="Same seed, same result to the byte.")] = 1,
    estimator: Annotated[
        Literal["presets", "adaptive", "predicting"],
        typer.Option(help="The profile's bands; what the link shows; the same, foreseeing regular falls."),
    ] = "adaptive",
    fast: Annotated[
        str | None, typer.Option(help="Profile of a second link, one way, with a carousel: finals-fast.")
    ] = None,
    fast_rate: Annotated[int, typer.Option(help="Its rate, bit/s; 95 % of its best band unless given.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder for what `straitlink report` reads.")] = None,
) -> None:
    """Run both shapers, the link and the traffic in virtual time, without waiting."""
    from netem_scripts.profiles import load_profile
    from straitlink.mission import MissionSettings, load_named_or_file
    from straitlink.mission.carousel import CarouselPlan
    from straitlink.mission.mission import adaptive, predicting, presets
    from straitlink.mission.output import print_result, run_and_save

    settings = MissionSettings(
        load_profile(profile),
        load_named_or_file(load),
        round(minutes * 60e9),
        seed,
        estimator={"presets": presets, "adaptive": adaptive, "predicting": predicting}[estimator],
        carousel=None if fast is None else CarouselPlan(load_profile(fast), fast_rate),
    )
    started_s = time.perf_counter()
    with progress_bar(f"mission {profile}", hidden=as_json) as on_progress:
        result = run_and_save(settings, out, on_progress)
    result["wall_s"] = round(time.perf_counter() - started_s, 3)
    if as_json:
        typer.echo(json.dumps(result, indent=1))
    else:
        print_result(result, wide_console())


@app.command()
def synthesize(
    out: Annotated[Path, typer.Option(help="The MCAP file to write.")] = Path("mission.mcap"),
    seconds: Annotated[float, typer.Option(min=0.1, max=86_400)] = 60.0,
    seed: Annotated[int, typer.Option(help="Same seed and settings, same file to the byte.")] = 1,
    light: Annotated[bool, typer.Option("--light", help="Small pictures, low rates, for tests.")] = False,
    texture: Annotated[Literal["busy", "indoor"], typer.Option(help="Outdoor or indoor scene.")] = "busy",
) -> None:
    """Write the synthetic robot mission as an MCAP log."""
    from straitlink.synthetic import SyntheticSettings, synthesize

    settings = SyntheticSettings(duration_s=seconds, seed=seed, light=light, texture=texture)
    with progress_bar("synthesize") as on_progress:
        summary = synthesize(out, settings, on_progress)
    typer.echo(
        f"{out}: {summary.messages} messages on {len(summary.topics)} topics, "
        f"{summary.messages_per_s:.0f} messages/s, {summary.payload_bytes_per_s / 1e6:.2f} MB/s, "
        f"file of {summary.file_bytes / 1e6:.1f} MB"
    )

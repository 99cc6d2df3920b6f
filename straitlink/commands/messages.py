"""`straitlink messages`: what each message costs, field by field."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from straitlink.dictionaries import TopicDictionary

app = typer.Typer(invoke_without_command=True)


@app.callback()
def messages(
    context: typer.Context,
    proto: Annotated[list[Path], typer.Option(help="A .proto file with DCCL bounds; may be repeated.")] = [],  # noqa: B006 (typer reads the default, nobody changes it)
    include: Annotated[list[Path], typer.Option("--include", "-I", help="Folder that it imports from.")] = [],  # noqa: B006
    as_json: Annotated[bool, typer.Option("--json", help="Print sizes as JSON.")] = False,
) -> None:
    """Print the topics and bounded messages of the catalogue, or the bit budgets of your .proto files."""
    if context.invoked_subcommand is not None:
        return
    if proto:
        _print_budgets(proto, include, as_json)
    else:
        _print_catalogue(as_json)
        if not as_json:
            _print_bounded()


@app.command()
def from_urdf(
    urdf: Annotated[Path, typer.Argument(help="The robot's URDF, expanded (no xacro).")],
    bits: Annotated[int | None, typer.Option(help="For each position, instead of a resolution.")] = None,
    resolution_rad: Annotated[float, typer.Option(help="Of turning joints, rad.")] = 0.001,
    resolution_m: Annotated[float, typer.Option(help="Of sliding joints, m.")] = 0.0005,
    velocity_bits: Annotated[int, typer.Option(help="For each velocity; 0 leaves them out.")] = 0,
    effort_bits: Annotated[int, typer.Option(help="For each effort; 0 leaves them out.")] = 0,
    margin_ratio: Annotated[float, typer.Option(help="Share of a range beyond each of its limits.")] = 0.0,
    stamp: Annotated[bool, typer.Option(help="Carry the sample's time, ms in 42 bits.")] = True,
    joints_from: Annotated[Path | None, typer.Option(help="A log: its joints only, in its order.")] = None,
    topic: Annotated[str | None, typer.Option(help="Of that log; the first with joint states.")] = None,
    out: Annotated[Path | None, typer.Option("-o", help="The .proto file; else it is printed.")] = None,
) -> None:
    """Make a .proto of a robot's joints, each with its own limits: a topic's encoding without code."""
    from messages.from_urdf import Detail, proto_of
    from messages.urdf import UrdfError, parse_urdf
    from straitlink.joint_log import joint_names_in

    try:
        robot = parse_urdf(urdf.read_bytes())
    except UrdfError as error:
        raise UrdfError(f"{urdf}: {error}") from error
    names = None if joints_from is None else joint_names_in(joints_from, topic)
    known = {joint.name for joint in robot.joints}
    missing = [name for name in names or () if name not in known]
    if missing:
        raise UrdfError(f"{urdf}: has no movable joint {missing[0]!r}, which {joints_from} tells")
    try:
        detail = Detail(
            bits, resolution_rad, resolution_m, velocity_bits, effort_bits, margin_ratio, has_stamp=stamp
        )
        text = proto_of(robot, detail, urdf.name, names)
    except ValueError as error:
        raise UrdfError(f"{urdf}: {error}") from error
    if out is None:
        typer.echo(text, nl=False)
    else:
        out.write_text(text)
        _print_budgets([out], [], as_json=False)


@app.command()
def train_dictionary(
    log: Annotated[Path, typer.Argument(help="MCAP file with messages like those that are to cross.")],
    out: Annotated[Path, typer.Option("-o", help="Folder for the dictionaries.")] = Path("dictionaries"),
    kilobytes: Annotated[int, typer.Option(help="Of a dictionary at most.", min=1, max=1000)] = 16,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Train a zstd dictionary for each topic of a log, and say what it gains on messages it has not seen."""
    from straitlink.dictionaries import config_snippet, train_dictionaries

    results = list(train_dictionaries(log, out, kilobytes * 1000))
    if as_json:
        rows = [
            {
                "topic": r.key,
                "trained_on": r.trained.trained_on,
                "held_out": r.trained.held_out,
                "raw_bytes": round(r.trained.raw_bytes, 1),
                "zstd_bytes": round(r.trained.zstd_bytes, 1),
                "dictionary_bytes": round(r.trained.dictionary_bytes, 1),
                "gain_ratio": round(r.trained.gain_ratio, 4),
                "file": None if r.file is None else str(r.file),
            }
            for r in results
        ]
        typer.echo(json.dumps(rows, indent=1))
        return
    _print_gains(results)
    typer.echo(config_snippet(results, out), nl=False)


def _print_gains(results: list[TopicDictionary]) -> None:
    from rich.box import SIMPLE
    from rich.table import Table

    from straitlink.commands.console import wide_console

    table = Table(
        title="Mean bytes of the last fifth of each topic", title_justify="left", box=SIMPLE, pad_edge=False
    )
    table.add_column("topic", no_wrap=True)
    for heading in ("messages", "raw", "zstd", "dictionary", "saves", "file"):
        table.add_column(heading, justify="left" if heading == "file" else "right", no_wrap=True)
    for result in results:
        t = result.trained
        sizes = (f"{size:,.0f}" for size in (t.raw_bytes, t.zstd_bytes, t.dictionary_bytes))
        file = "not worth one" if result.file is None else result.file.name
        count = f"{t.trained_on + t.held_out:,}"
        table.add_row(result.key, count, *sizes, f"{max(0.0, t.gain_ratio):.0%}", file)
    wide_console().print(table)


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


def _print_bounded() -> None:
    from messages.bounded_catalogue import BOUNDED_CATALOGUE
    from messages.dccl import Codec

    for message in BOUNDED_CATALOGUE:
        typer.echo(f"{Codec(message.message_type).info()}\n")


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

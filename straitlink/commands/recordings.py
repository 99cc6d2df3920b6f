"""`straitlink replay`, `record`, `recover` and `report`: logs in, logs out, and what they say."""

from __future__ import annotations

import json
import signal
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from straitlink.commands.console import wide_console
from straitlink.commands.progress import progress_bar

if TYPE_CHECKING:
    from shaper.bus import BusSettings

app = typer.Typer()

Connect = Annotated[list[str], typer.Option("--connect", "-e", help="Zenoh endpoint, tcp/127.0.0.1:7447.")]
Listen = Annotated[list[str], typer.Option("--listen", "-l", help="Zenoh endpoint to listen on.")]


def bus_at(listen: list[str], connect: list[str]) -> BusSettings:
    """The bus that the options name. Raises BusError where they name none."""
    from shaper.bus import BusError, BusSettings

    if not listen and not connect:
        raise BusError("give --connect or --listen: the bus to open")
    return BusSettings(listen, connect)


def stop_on_signals() -> threading.Event:
    """An event that SIGTERM and SIGINT set."""
    stop = threading.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda _number, _frame: stop.set())
    return stop


@app.command()
def replay(
    log: Annotated[Path, typer.Argument(help="MCAP file: Foxglove protobuf, ROS 2 CDR or JSON.")],
    connect: Connect = [],  # noqa: B006 (typer reads the default, nobody changes it)
    listen: Listen = [],  # noqa: B006
    rate: Annotated[float, typer.Option(help="Log seconds per second.")] = 1.0,
    loop: Annotated[int, typer.Option(help="Passes over the log; 0 repeats until stopped.")] = 1,
    topics: Annotated[list[str], typer.Option(help="Topic or key expression; may be repeated.")] = [],  # noqa: B006
    exclude: Annotated[list[str], typer.Option(help="Leave these out; may be repeated.")] = [],  # noqa: B006
    start: Annotated[float, typer.Option(help="Seconds from the log's start.")] = 0.0,
    end: Annotated[float | None, typer.Option(help="Seconds from the log's start.")] = None,
    stamp: Annotated[
        Literal["now", "log"], typer.Option(help="Shift capture times to the present, or keep the log's.")
    ] = "now",
) -> None:
    """Publish a log on a Zenoh bus with its own timing, payload bytes untouched."""
    from straitlink.replay import Progress, ReplaySettings
    from straitlink.replay import replay as run

    with progress_bar(f"replay {log.name}") as on_progress:

        def show(progress: Progress) -> None:
            on_progress(progress.position_s / progress.duration_s if progress.duration_s else 1.0)

        summary = run(
            ReplaySettings(
                log,
                bus_at(listen, connect),
                rate=rate,
                loop=loop,
                include=topics,
                exclude=exclude,
                start_s=start,
                end_s=end,
                stamp=stamp,
                stop=stop_on_signals(),
                on_progress=show,
            )
        )
    typer.echo(
        f"replay: {summary.messages} messages, {summary.payload_bytes} bytes in {summary.wall_s:.1f} s; "
        f"late by p50 {summary.late_p50_ms:.2f}, p95 {summary.late_p95_ms:.2f}, "
        f"max {summary.late_max_ms:.1f} ms",
        err=True,
    )
    for topic in summary.unmatched_topics:
        typer.echo(f"replay: nobody subscribes to {topic}", err=True)


@app.command()
def record(
    out: Annotated[Path, typer.Argument(help="The MCAP file to write.")],
    connect: Connect = [],  # noqa: B006
    listen: Listen = [],  # noqa: B006
    keys: Annotated[list[str], typer.Option("--key", help="Key expression; may be repeated.")] = ["**"],  # noqa: B006
    schemas: Annotated[
        list[Path],
        typer.Option(help="MCAP file whose schemas the recording may need."),
    ] = [],  # noqa: B006
    config: Annotated[list[Path], typer.Option(help="File to carry inside, such as a configuration.")] = [],  # noqa: B006
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace OUT where it exists.")] = False,
) -> None:
    """Record a Zenoh bus as MCAP (log_time = arrival, publish_time = capture), until Ctrl-C."""
    from straitlink.record import AttachedFile, RecordSettings
    from straitlink.record import record as run

    attachments = [AttachedFile(path.name, "application/toml", path.read_bytes()) for path in config]
    summary = run(
        RecordSettings(
            out,
            bus_at(listen, connect),
            overwrite=overwrite,
            keys=keys,
            logs=schemas,
            attachments=attachments,
            stop=stop_on_signals(),
            on_ready=lambda: typer.echo(f"record: {out} is open", err=True),
        )
    )
    typer.echo(f"record: {summary.messages} messages on {len(summary.topics)} topics in {out}", err=True)
    if summary.dropped:
        typer.echo(f"record: {summary.dropped} messages dropped, the disk did not keep up", err=True)
    for topic in summary.schemaless:
        typer.echo(f"record: {topic} has no schema that we know; --schemas LOG.mcap gives it one", err=True)


@app.command()
def recover(
    log: Annotated[Path, typer.Argument(help="A recording that was cut off.")],
    out: Annotated[
        Path | None, typer.Option(help="Where to write; NAME_recovered.mcap beside it unless given.")
    ] = None,
) -> None:
    """Make a valid MCAP file of what a killed recorder left."""
    from straitlink.recording import recover as run

    typer.echo(str(run(log, out)))


@app.command()
def report(
    run_folder: Annotated[
        Path, typer.Argument(metavar="RUN", help="Folder of a run, a trace, or an MCAP file.")
    ],
    html: Annotated[Path | None, typer.Option(help="The page; RUN/report.html unless given.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the figures as JSON.")] = False,
) -> None:
    """Show what became of each topic, and write a page with plots."""
    import dataclasses

    from straitlink.report import print_table, read_run, summarise, write_page

    run = read_run(run_folder)
    summary = summarise(run)
    if as_json:
        typer.echo(json.dumps(dataclasses.asdict(summary), indent=1, default=str))
    else:
        print_table(summary, wide_console())
    beside = run_folder / "report.html" if run_folder.is_dir() else run_folder.with_suffix(".html")
    typer.echo(f"report: {write_page(run, summary, html or beside)}", err=True)

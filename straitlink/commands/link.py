"""`straitlink link`: the thin link, applied in one of its ways."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from netem_scripts.band import Profile
    from netem_scripts.sides import SidesReport

app = typer.Typer()

_SEPARATOR = ":::"


class Way(StrEnum):
    """How the profile is applied."""

    UDP = "udp"
    TUN = "tun"
    NETEM = "netem"
    GUEST = "guest"
    TC = "tc"


@app.command()
def link(
    commands: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[-- COMMAND_A ::: COMMAND_B]", help="The robot's and the operator's command."
        ),
    ] = None,
    profile: Annotated[str, typer.Option(help="Name of a link profile, or a TOML or CSV file.")] = "trials",
    udp: Annotated[bool, typer.Option("--udp", help="Between two UDP ports (the default).")] = False,
    tun: Annotated[bool, typer.Option("--tun", help="Between two namespaces that commands run in.")] = False,
    netem: Annotated[bool, typer.Option("--netem", help="As --tun, by this kernel's netem.")] = False,
    guest: Annotated[bool, typer.Option("--guest", help="As --netem, in user-mode Linux.")] = False,
    tc: Annotated[bool, typer.Option("--tc", help="On this host's interface, by netem.")] = False,
    interface: Annotated[str | None, typer.Option(help="For --tc: the device, such as eth0.")] = None,
    direction: Annotated[str, typer.Option(help="For --tc: down on the robot, up on the operator.")] = "down",
    apply: Annotated[bool, typer.Option("--apply", help="For --tc: do it, rather than print it.")] = False,
    packet_bytes: Annotated[int, typer.Option(help="For netem: IP packets that its buffer counts.")] = 1228,
    timeout: Annotated[float, typer.Option(help="For --guest: seconds until it is ended.")] = 600.0,
    robot_side: Annotated[str, typer.Option(help="Where the robot's shaper sends to.")] = "127.0.0.1:9101",
    operator_side: Annotated[str, typer.Option(help="Where the operator's sends to.")] = "127.0.0.1:9102",
    robot_peer: Annotated[str, typer.Option(help="Where the robot's shaper listens.")] = "127.0.0.1:9001",
    operator_peer: Annotated[str, typer.Option(help="Where the operator's listens.")] = "127.0.0.1:9002",
    linger: Annotated[float, typer.Option(help="Seconds that COMMAND_B may go on after COMMAND_A.")] = 15.0,
    seed: Annotated[int, typer.Option(help="Of loss, jitter and duplication.")] = 1,
    trace: Annotated[Path | None, typer.Option(help="Write each packet's fate as JSON lines.")] = None,
    list_profiles: Annotated[bool, typer.Option("--list", help="Print the profiles and stop.")] = False,
    plot: Annotated[Path | None, typer.Option(help="Draw the profile as SVG to this file and stop.")] = None,
) -> None:
    """Emulate a thin link.

    --udp: between two UDP ports, until SIGTERM or Ctrl-C.

    --tun, --netem, --guest: between the two namespaces that the commands run in, 10.71.0.1 for COMMAND_A and
    10.71.0.2 for COMMAND_B; ends with COMMAND_A and with its exit code.

    --tc: on one direction of a real interface, until SIGTERM or Ctrl-C.
    """
    from netem_scripts.guest import run_guest
    from netem_scripts.profiles import load_profile
    from netem_scripts.veth import VethSettings, run_veth

    if list_profiles:
        return _print_profiles()
    resolved = load_profile(profile)
    if plot is not None:
        from netem_scripts.picture import picture

        plot.write_text(picture(resolved), encoding="utf-8")
        return
    way = _the_way({Way.UDP: udp, Way.TUN: tun, Way.NETEM: netem, Way.GUEST: guest, Way.TC: tc})
    if way in (Way.UDP, Way.TC) and commands:
        raise typer.BadParameter("commands run with --tun, --netem or --guest", param_hint="COMMAND_A")
    if way is not Way.TC and (apply or interface):
        raise typer.BadParameter("goes with --tc", param_hint="--apply" if apply else "--interface")
    with _one_line_errors():
        if way is Way.UDP:
            return _run_udp(resolved, (robot_side, operator_side), (robot_peer, operator_peer), seed, trace)
        if way is Way.TC:
            return _run_tc(resolved, interface, direction, packet_bytes, apply)
        if trace is not None and way is not Way.TUN:
            raise typer.BadParameter("the kernel's netem keeps no trace", param_hint="--trace")
        robot, operator = _both(commands or [])
        if way is Way.TUN:
            _finish(_run_tun(resolved, robot, operator, seed, linger, trace))
        if way is Way.NETEM:
            _finish(run_veth(VethSettings(resolved, robot, operator, linger, packet_bytes)))
        options = ["--profile", profile, "--linger", str(linger), "--packet-bytes", str(packet_bytes)]
        raise typer.Exit(run_guest(_netem_inside(options, robot, operator), timeout))


def _netem_inside(options: list[str], robot: list[str], operator: list[str]) -> list[str]:
    """This command once more, by netem, for the guest's kernel."""
    again = [sys.executable, "-m", "straitlink", "link", "--netem", *options]
    return [*again, "--", *robot, _SEPARATOR, *operator]


def _the_way(asked: dict[Way, bool]) -> Way:
    ways = [way for way, wanted in asked.items() if wanted]
    if len(ways) > 1:
        raise typer.BadParameter("only one way at a time", param_hint=" ".join(f"--{way}" for way in ways))
    return ways[0] if ways else Way.UDP


@contextmanager
def _one_line_errors() -> Iterator[None]:
    """What the machine refuses is one line and exit code 2."""
    from netem_scripts.container import ContainerError
    from netem_scripts.guest import GuestError
    from netem_scripts.tc import TcError

    try:
        yield
    except (ContainerError, GuestError, TcError) as error:
        typer.echo(f"straitlink: {error}", err=True)
        raise typer.Exit(2) from error


def _both(commands: Sequence[str]) -> tuple[list[str], list[str]]:
    words = list(commands)
    if words.count(_SEPARATOR) == 1:
        at = words.index(_SEPARATOR)
        robot, operator = words[:at], words[at + 1 :]
        if robot and operator:
            return robot, operator
    raise typer.BadParameter("give two commands: -- COMMAND_A ::: COMMAND_B", param_hint="COMMAND_A")


def _run_udp(
    profile: Profile, sides: tuple[str, str], peers: tuple[str, str], seed: int, trace: Path | None
) -> None:
    from netem_scripts.udp_proxy import ProxySettings
    from straitlink.processes import run_link, run_until_signal

    settings = ProxySettings(profile, *sides, *peers, seed)
    typer.echo(f"link: {profile.name} between {sides[0]} and {sides[1]}", err=True)
    report = run_until_signal(lambda stop: run_link(settings, trace, stop))
    for direction, counts in (("down", report.down), ("up", report.up)):
        typer.echo(f"link: {direction} {counts}", err=True)


def _run_tun(
    profile: Profile,
    robot: Sequence[str],
    operator: Sequence[str],
    seed: int,
    linger_s: float,
    trace: Path | None,
) -> SidesReport:
    from netem_scripts.tun import TunSettings, run_tun
    from straitlink.processes import link_trace

    settings = TunSettings(profile, robot, operator, seed, linger_s)
    with link_trace(trace, profile) as write:
        return run_tun(settings, on_packet=write, on_band=write)


def _run_tc(profile: Profile, device: str | None, which: str, packet_bytes: int, apply: bool) -> None:
    from netem_scripts.tc import Interface, NetemSchedule, apply_until_signal

    if device is None:
        raise typer.BadParameter("give the device to shape", param_hint="--interface")
    if which not in ("down", "up"):
        raise typer.BadParameter(f"{which} must be down or up", param_hint="--direction")
    direction = profile.down if which == "down" else profile.up
    where = Interface(device)
    for line in NetemSchedule(direction, where, packet_bytes).script():
        typer.echo(line)
    if apply:
        typer.echo(f"link: {profile.name} {which} on {device}, until SIGTERM or Ctrl-C", err=True)
        apply_until_signal(direction, where, packet_bytes)


def _finish(report: SidesReport) -> None:
    if report.link is not None:
        for direction, counts in (("down", report.link.down), ("up", report.link.up)):
            typer.echo(f"link: {direction} {counts}", err=True)
    raise typer.Exit(report.exit_code)


def _print_profiles() -> None:
    from rich.box import SIMPLE
    from rich.markup import escape
    from rich.table import Table

    from netem_scripts.profiles import CONSTANT_FORM, named_profiles
    from straitlink.commands.console import wide_console

    table = Table(box=SIMPLE, padding=(0, 1))
    for heading in ("name", "what", "buffer", "source"):
        table.add_column(heading, overflow="fold", no_wrap=heading == "name")
    for each in named_profiles():
        table.add_row(each.name, each.description, _buffer(each), each.source)
    example = "constant-1m-50ms-loss2.5-jitter10ms-buffer100ms"
    what = f"one band for ever, both ways: {CONSTANT_FORM}, such as {example}"
    table.add_row("constant-...", escape(what), "10 s", "its name")
    table.add_row("finals-<seed>", "the Finals with the blackouts in another order", "", "as finals")
    wide_console().print(table)


def _buffer(profile: Profile) -> str:
    direction = profile.down
    limits = []
    if direction.buffer_ns is not None:
        limits.append(f"{direction.buffer_ns / 1e9:.3g} s")
    if direction.buffer_bytes is not None:
        limits.append(f"{direction.buffer_bytes:,} B")
    return ", ".join(limits)

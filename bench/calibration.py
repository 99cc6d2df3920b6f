"""What each way of applying a link really gives, beside what was asked: `python -m bench.calibration`.

Every run sends the same probes and the same bulk, as a program with a UDP socket does, and is judged by the
same arithmetic on what was sent and received when. Ways that this machine cannot run are named and left out.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from bench.machine import provenance
from netem_scripts.band import IP_UDP_HEADER_BYTES, Band
from netem_scripts.guest import GuestError, check_guest
from netem_scripts.link import Link
from netem_scripts.network import OPERATOR_ADDRESS
from netem_scripts.profiles import profile_named

OUT = Path("out/bench/calibration.json")
PROBE_BYTES, PROBES, PROBE_INTERVAL_S = 100, 100, 0.03
BULK_BYTES = 1200
SETTLE_S = 2.0  # before the first packet, and after the last beyond delay and buffer
PORT = 7100
_SO_SNDBUFFORCE = 32  # Linux: netem on the sender's own host holds what its socket has sent
_NUMBER_BYTES = 4


@dataclass(frozen=True, slots=True)
class Run:
    """Probes, then bulk at a multiple of the rate: above 1 fills the buffer, below 1 counts the loss."""

    profile: str
    bulk_load: float
    bulk_packets: int

    @property
    def band(self) -> Band:
        """The only one."""
        return profile_named(self.profile).down.bands[0]

    @property
    def buffer_s(self) -> float:
        """What was asked for."""
        return (profile_named(self.profile).down.buffer_ns or 0) / 1e9

    def plan(self) -> list[tuple[float, int]]:
        """(when in s, payload bytes) of every packet; its place in the list is its number."""
        packets = [(SETTLE_S + n * PROBE_INTERVAL_S, PROBE_BYTES) for n in range(PROBES)]
        begin_s = SETTLE_S + PROBES * PROBE_INTERVAL_S + 1.0
        interval_s = wire_s(BULK_BYTES, self.band) / self.bulk_load
        packets += [(begin_s + n * interval_s, BULK_BYTES) for n in range(self.bulk_packets)]
        return packets

    @property
    def length_s(self) -> float:
        """From the start until the last packet has arrived."""
        return self.plan()[-1][0] + self.band.one_way_delay_ns / 1e9 + self.buffer_s + SETTLE_S


RUNS = (
    Run("constant-1m-50ms-buffer1000ms", 2.0, 1200),
    Run("constant-100k-500ms-buffer2000ms", 2.0, 200),
    Run("constant-10m-20ms-loss10-buffer1000ms", 0.5, 4000),
)


@dataclass(frozen=True, slots=True)
class Figures:
    """One run. Measured values beside those asked for; None: the run does not tell it."""

    way: str
    profile: str
    rate_bps: int
    measured_rate_bps: float | None
    delay_ms: float
    measured_delay_ms: float
    buffer_s: float
    measured_buffer_s: float | None
    loss_ratio: float
    measured_loss_ratio: float | None
    loss_sigmas: float | None

    def misses(self, delay_tolerance_ms: float) -> list[str]:
        """The names of the figures that are out of tolerance: 2 % of rate, 5 % of buffer, 4 sigma of loss."""
        found = []
        if self.measured_rate_bps is not None and abs(self.measured_rate_bps / self.rate_bps - 1) > 0.02:
            found.append("rate")
        if abs(self.measured_delay_ms - self.delay_ms) > delay_tolerance_ms:
            found.append("delay")
        if self.measured_buffer_s is not None and abs(self.measured_buffer_s / self.buffer_s - 1) > 0.05:
            found.append("buffer")
        if self.loss_sigmas is not None and abs(self.loss_sigmas) > 4:
            found.append("loss")
        return found


Times = dict[int, tuple[int, int | None]]
"""Packet number to when it was sent and received, in ns of one clock; None: never."""


def wire_s(payload_bytes: int, band: Band) -> float:
    """How long a packet is in service."""
    return (payload_bytes + IP_UDP_HEADER_BYTES) * 8 / band.rate_bps


def judge(way: str, run: Run, times: Times) -> Figures:
    """The figures of one run."""
    band = run.band
    delays_s = sorted(
        (got - sent) / 1e9 - wire_s(PROBE_BYTES, band)
        for number, (sent, got) in times.items()
        if number < PROBES and got is not None
    )
    bulk = [(sent, got) for number, (sent, got) in times.items() if number >= PROBES]
    arrived = sorted((got, sent) for sent, got in bulk if got is not None)
    saturated, lossy = run.bulk_load > 1, band.loss_ratio > 0
    rate_bps = buffer_s = loss_ratio = sigmas = None
    if saturated:
        span_s = (arrived[-1][0] - arrived[0][0]) / 1e9
        rate_bps = (len(arrived) - 1) * (BULK_BYTES + IP_UDP_HEADER_BYTES) * 8 / span_s
        buffer_s = max(got - sent for got, sent in arrived) / 1e9 - band.one_way_delay_ns / 1e9
    if lossy:
        loss_ratio = 1 - len(arrived) / len(bulk)
        sigma = math.sqrt(band.loss_ratio * (1 - band.loss_ratio) / len(bulk))
        sigmas = (loss_ratio - band.loss_ratio) / sigma
    return Figures(
        way, run.profile, band.rate_bps, rate_bps, band.one_way_delay_ns / 1e6,
        delays_s[len(delays_s) // 2] * 1000, run.buffer_s, buffer_s, band.loss_ratio, loss_ratio, sigmas,
    )  # fmt: skip


def in_virtual_time(run: Run, seed: int) -> Times:
    """The link itself."""
    link = Link(profile_named(run.profile).down, random.Random(seed))
    times: Times = {}
    for number, (at_s, size) in enumerate(run.plan()):
        sent_ns = round(at_s * 1e9)
        passage = link.transmit(size, sent_ns)
        times[number] = (sent_ns, passage.arrivals_ns[0] if passage.arrivals_ns else None)
    return times


def over_udp(run: Run, seed: int) -> Times:
    """Through the proxy, both programs on loopback."""
    robot_side, operator_side, robot, operator = _free_ports(4)
    sides = ["--robot-side", f"127.0.0.1:{robot_side}", "--operator-side", f"127.0.0.1:{operator_side}"]
    peers = ["--robot-peer", f"127.0.0.1:{robot}", "--operator-peer", f"127.0.0.1:{operator}"]
    with _folder() as name:
        folder = Path(name)
        link = subprocess.Popen(
            [*_LINK, "--profile", run.profile, "--seed", str(seed), *sides, *peers], stderr=subprocess.DEVNULL
        )
        try:
            receiver = subprocess.Popen(_command("receive", run, folder, f"127.0.0.1:{operator}"))
            subprocess.run(_command("send", run, folder, f"127.0.0.1:{robot_side}"), check=True)
            receiver.wait(30)
        finally:
            link.terminate()
            link.wait(10)
        return _read(folder, run)


def between_namespaces(run: Run, seed: int) -> Times:
    """Through the TUN pair."""
    return _with_commands(run, ["--tun", "--seed", str(seed)])


def in_the_guest(run: Run, seed: int) -> Times:
    """Through a real kernel's netem; its chance has no seed."""
    del seed
    return _with_commands(run, ["--guest", "--timeout", str(run.length_s + 60)])


WAYS: dict[str, tuple[Callable[[Run, int], Times], float]] = {
    "virtual": (in_virtual_time, 5.0),
    "udp": (over_udp, 5.0),
    "tun": (between_namespaces, 5.0),
    "guest": (in_the_guest, 10.0),
}
"""How each is run, and the tolerance of its delay in ms."""

_LINK = [sys.executable, "-m", "straitlink", "link"]


def why_not(way: str) -> str:
    """Why this machine cannot run a way; empty if it can."""
    if way in ("tun", "guest") and (os.geteuid() != 0 or not os.access("/dev/net/tun", os.W_OK)):
        return "needs root and /dev/net/tun"
    if way == "guest":
        try:
            check_guest()
        except GuestError as error:
            return str(error)
    return ""


def send(run: Run, folder: Path, address: str) -> None:
    """The robot's program: the plan, by absolute times; then the file of when each was sent."""
    host, port = address.rsplit(":", 1)
    link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    if os.geteuid() == 0:
        link.setsockopt(socket.SOL_SOCKET, _SO_SNDBUFFORCE, 1 << 24)
    begin_s, sent_ns = time.monotonic(), []
    for number, (at_s, size) in enumerate(run.plan()):
        time.sleep(max(0.0, begin_s + at_s - time.monotonic()))
        sent_ns.append(time.monotonic_ns())
        link.sendto(number.to_bytes(_NUMBER_BYTES, "big").ljust(size, b"\0"), (host, int(port)))
    (folder / "sent.json").write_text(json.dumps(sent_ns))
    time.sleep(run.length_s - run.plan()[-1][0])


def receive(run: Run, folder: Path, address: str) -> None:
    """The operator's program: what came when."""
    host, port = address.rsplit(":", 1)
    link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
    link.bind((host, int(port)))
    end_s, received_ns = time.monotonic() + run.length_s - SETTLE_S / 2, {}
    while (left_s := end_s - time.monotonic()) > 0:
        link.settimeout(left_s)
        try:
            number = int.from_bytes(link.recv(2048)[:_NUMBER_BYTES], "big")
        except TimeoutError:
            break
        received_ns.setdefault(number, time.monotonic_ns())
    (folder / "received.json").write_text(json.dumps(received_ns))


def _with_commands(run: Run, options: list[str]) -> Times:
    with _folder() as name:
        folder = Path(name)
        address = f"{OPERATOR_ADDRESS}:{PORT}"
        sides = [*_command("send", run, folder, address), ":::", *_command("receive", run, folder, address)]
        counted = ["--packet-bytes", str(BULK_BYTES + IP_UDP_HEADER_BYTES)]
        command = [*_LINK, "--profile", run.profile, *counted, *options, "--", *sides]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"the link ended with code {done.returncode}: {done.stderr.strip()}")
        return _read(folder, run)


def _command(part: str, run: Run, folder: Path, address: str) -> list[str]:
    return [sys.executable, "-m", "bench.calibration", "--part", part, run.profile, str(folder), address]


def _read(folder: Path, run: Run) -> Times:
    sent_ns = json.loads((folder / "sent.json").read_text())
    received_ns = json.loads((folder / "received.json").read_text())
    return {n: (sent_ns[n], received_ns.get(str(n))) for n in range(len(run.plan()))}


def _folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="calibration-")


def _free_ports(count: int) -> Iterator[int]:
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    for each in sockets:
        each.bind(("127.0.0.1", 0))
    ports = [int(each.getsockname()[1]) for each in sockets]
    for each in sockets:
        each.close()
    return iter(ports)


def main() -> int:
    """Print a table and leave the figures in out/bench/calibration.json; 1 if one is out of tolerance."""
    from rich.box import SIMPLE
    from rich.console import Console
    from rich.table import Table

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("ways", nargs="*", default=list(WAYS), help=f"of {', '.join(WAYS)}")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--part", nargs=4, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.part:
        part, profile, folder, address = arguments.part
        run = next(run for run in RUNS if run.profile == profile)
        {"send": send, "receive": receive}[part](run, Path(folder), address)
        return 0
    table = Table(title="Asked and measured", title_justify="left", box=SIMPLE, padding=0)
    for heading in ("way, profile", "rate kbit/s", "delay ms", "buffer s", "loss %", "sigma", "verdict"):
        table.add_column(heading, justify="left" if "way" in heading else "right", no_wrap=True)
    figures, failed = [], False
    for way in arguments.ways:
        if reason := why_not(way):
            print(f"{way} left out: {reason}", file=sys.stderr)
            continue
        measure, delay_tolerance_ms = WAYS[way]
        for run in RUNS:
            f = judge(way, run, measure(run, arguments.seed))
            misses = f.misses(delay_tolerance_ms)
            failed = failed or bool(misses)
            figures.append(f)
            table.add_row(
                f"{way}, {run.profile} ",
                f" {f.rate_bps / 1000:g} {_shown(f.measured_rate_bps, 1000, 1)}",
                f" {f.delay_ms:g} {f.measured_delay_ms:.2f}",
                f" {f.buffer_s:g} {_shown(f.measured_buffer_s, 1, 3)}",
                f" {f.loss_ratio:.0%} {_shown(f.measured_loss_ratio, 0.01, 2)}",
                f" {_shown(f.loss_sigmas, 1, 1)}",
                " " + (", ".join(misses) or "ok"),
            )
    OUT.parent.mkdir(parents=True, exist_ok=True)
    OUT.write_text(json.dumps({**provenance(), "runs": [asdict(f) for f in figures]}, indent=1))
    console = Console()
    console.width = max(console.width, 130)
    console.print(table)
    return 1 if failed else 0


def _shown(value: float | None, unit: float, digits: int) -> str:
    return "-" if value is None else f"{value / unit:.{digits}f}"


if __name__ == "__main__":
    sys.exit(main())

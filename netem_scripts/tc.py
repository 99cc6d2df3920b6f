"""The same profile as netem on a real interface: printed, applied, changed on schedule, verified, removed.

One host shapes what it sends; the robot's host applies the profile's down, the operator's host its up.
"""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from .band import DirectionProfile
from .link import Link
from .netem_arguments import HALF_NORMAL, NetemBand, half_normal_table, netem_band

HANDLE = "71:"
PACKET_BYTES = 1228  # the largest IP packet of a straitlink shaper
_PRINTED_BANDS = 200


class TcError(Exception):
    """tc refused, or the kernel has something else than was asked for; the message says what."""


@dataclass(frozen=True, slots=True)
class Interface:
    """Where: a device of this network namespace, or of that of a process."""

    device: str
    pid: int | None = None

    def command(self, *words: str) -> list[str]:
        """A command line that runs in the right namespace."""
        inside = [] if self.pid is None else ["nsenter", "--net", "--target", str(self.pid)]
        return [*inside, *words]

    def netem(self, verb: str, band: NetemBand) -> list[str]:
        """The tc command that adds or changes the qdisc."""
        words = ("tc", "qdisc", verb, "dev", self.device, "root", "handle", HANDLE, "netem")
        return self.command(*words, *band.arguments())

    def remove(self) -> list[str]:
        """The tc command that removes it."""
        return self.command("tc", "qdisc", "del", "dev", self.device, "root", "handle", HANDLE)


class NetemSchedule:
    """One direction on one interface: what to do when. Times count from the start of the schedule."""

    def __init__(self, direction: DirectionProfile, interface: Interface, packet_bytes: int) -> None:
        self._interface = interface
        self._bands = {
            band: netem_band(direction, index, packet_bytes) for index, band in enumerate(direction.bands)
        }
        self._direction = direction
        self._link = Link(direction, _NoChance())

    def band_at(self, at_ns: int) -> NetemBand:
        """What is in force."""
        return self._bands[self._link.band_at(at_ns)]

    def next_change_ns(self, at_ns: int) -> int | None:
        """When it changes next; None if never."""
        return self._link.next_change_ns(at_ns)

    def apply(self, at_ns: int) -> None:
        """Put the band of at_ns in force, adding the qdisc at 0, and read it back. Raises TcError."""
        band = self.band_at(at_ns)
        with _tables(band):
            run(self._interface.netem("add" if at_ns == 0 else "change", band))
        differences = band.differences(netem_options(self._interface))
        if differences:
            raise TcError(f"{self._interface.device}: {'; '.join(differences)}.")

    def script(self) -> Iterator[str]:
        """The commands as a person would type them, with the times of one cycle as comments."""
        at_ns: int | None = 0
        printed, verb = 0, "add"
        while at_ns is not None and printed < _PRINTED_BANDS:
            yield f"# at {at_ns / 1e9:g} s"
            yield shlex.join(self._interface.netem(verb, self.band_at(at_ns)))
            at_ns, verb, printed = self.next_change_ns(at_ns), "change", printed + 1
            if self._direction.cyclic and printed == len(self._direction.bands):
                yield f"# at {(at_ns or 0) / 1e9:g} s from the top, with change"
                break
        else:
            if at_ns is not None:
                yield f"# and so on: {len(self._direction.bands)} bands"
        yield "# at the end"
        yield shlex.join(self._interface.remove())


def run(command: Sequence[str], text: str = "") -> str:
    """What the command prints, given a text to read. Raises TcError with what it says when it fails."""
    try:
        done = subprocess.run(command, input=text, capture_output=True, text=True, check=False, timeout=30)
    except OSError as error:
        raise TcError(f"{command[0]}: {error.strerror}; apt-get install iproute2 has it.") from error
    if done.returncode:
        said = " ".join((done.stderr or done.stdout).split())
        raise TcError(f"{shlex.join(command)}: {said or f'exit code {done.returncode}'}.")
    return done.stdout


def netem_options(interface: Interface) -> dict[str, object]:
    """The options of our qdisc as the kernel tells them. Raises TcError when it is not there."""
    for qdisc in _qdiscs(interface):
        if qdisc.get("kind") == "netem" and qdisc.get("handle") == HANDLE:
            options = qdisc["options"]
            assert isinstance(options, dict)
            return options
    raise TcError(f"{interface.device}: the netem qdisc {HANDLE} is gone.")


def check_free(interface: Interface) -> None:
    """Raise TcError when somebody has set a root qdisc: removing ours would not bring it back."""
    for qdisc in _qdiscs(interface):
        if qdisc.get("root") and qdisc.get("handle") != "0:":
            raise TcError(
                f"{interface.device}: it has a qdisc of its own, {qdisc['kind']} {qdisc['handle']}; "
                f"remove it first (tc qdisc del dev {interface.device} root)."
            )


@contextmanager
def _tables(band: NetemBand) -> Iterator[None]:
    """Let tc find our table of half-normal jitter; only while it runs, as a kill would leave the file."""
    if band.distribution is None:
        yield
        return
    with tempfile.TemporaryDirectory(prefix="straitlink-tc-") as folder:
        (Path(folder) / f"{HALF_NORMAL}.dist").write_text(half_normal_table())
        before = os.environ.get("TC_LIB_DIR")
        os.environ["TC_LIB_DIR"] = folder
        try:
            yield
        finally:
            del os.environ["TC_LIB_DIR"]
            if before is not None:
                os.environ["TC_LIB_DIR"] = before


def apply_until_signal(
    direction: DirectionProfile, interface: Interface, packet_bytes: int = PACKET_BYTES
) -> None:
    """Apply a direction to an interface until SIGTERM or SIGINT, then remove it. Raises TcError.

    A guard process removes the qdisc if this one is killed; if the guard is killed, this one does and ends.
    """
    schedule = NetemSchedule(direction, interface, packet_bytes)
    check_free(interface)
    stop = _StopFlag()
    with _guard(interface) as guard:
        try:
            schedule.apply(0)
            start_ns, at_ns = time.monotonic_ns(), 0
            while not stop.set:
                if guard.poll() is not None:
                    raise TcError(f"{interface.device}: the guard process was killed.")
                change_ns = schedule.next_change_ns(at_ns)
                left_s = 0.1 if change_ns is None else (start_ns + change_ns - time.monotonic_ns()) / 1e9
                if change_ns is None or left_s > 0:
                    time.sleep(min(0.1, left_s))
                    continue
                at_ns = change_ns
                schedule.apply(at_ns)
        finally:
            subprocess.run(interface.remove(), capture_output=True, check=False)


def guard(arguments: Sequence[str]) -> int:
    """The guard's life: wait for the end of its input, that is of who started it, and remove the qdisc."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    sys.stdin.buffer.read()
    subprocess.run(list(arguments), capture_output=True, check=False)
    return 0


@contextmanager
def _guard(interface: Interface) -> Iterator[subprocess.Popen[bytes]]:
    package_home = str(Path(__file__).resolve().parents[1])
    process = subprocess.Popen(
        [sys.executable, "-m", "netem_scripts", "guard", *interface.remove()],
        stdin=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": package_home},
        start_new_session=True,
    )
    try:
        yield process
    finally:
        assert process.stdin is not None
        process.stdin.close()
        process.wait()


def _qdiscs(interface: Interface) -> list[dict[str, object]]:
    shown = run(interface.command("tc", "-j", "qdisc", "show", "dev", interface.device))
    found = json.loads(shown or "[]")
    assert isinstance(found, list)
    return found


class _StopFlag:
    """Set by SIGTERM and SIGINT."""

    def __init__(self) -> None:
        self.set = False
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._on_signal)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.set = True


class _NoChance:
    """For a link that is asked for its schedule only."""

    def random(self) -> float:
        raise AssertionError("the schedule draws nothing")

    def gauss(self, mu: float, sigma: float) -> float:
        raise AssertionError("the schedule draws nothing")

    def getrandbits(self, k: int, /) -> int:
        raise AssertionError("the schedule draws nothing")

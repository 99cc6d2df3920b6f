"""The demonstration's processes: started in order, stopped in order, none left behind."""

from __future__ import annotations

import ctypes
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from straitlink.demo.errors import DemoError

_PR_SET_PDEATHSIG = 1  # Linux, prctl(2): the kernel signals the child when its parent dies
_libc = ctypes.CDLL(None)


@dataclass(slots=True)
class Child:
    """One `straitlink` process and the file that holds what it prints."""

    name: str
    process: subprocess.Popen[bytes]
    log: Path

    @property
    def running(self) -> bool:
        return self.process.poll() is None

    def stop(self, timeout_s: float = 8.0) -> None:
        """Ask it to end, wait, and kill it if it does not."""
        if self.running:
            self.process.send_signal(signal.SIGTERM)
        try:
            self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()

    def last_words(self) -> str:
        """The last line that it printed."""
        lines = self.log.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "(it printed nothing)"


class Children:
    """All processes of a run; leaving the context stops them, the youngest first."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._children: list[Child] = []

    def start(self, name: str, arguments: Sequence[str]) -> Child:
        """Start `straitlink ARGUMENTS`; it does not see Ctrl-C, and ends if this process dies."""
        log = self._folder / f"{name}.log"
        with log.open("wb") as output:
            process = subprocess.Popen(
                [sys.executable, "-m", "straitlink", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=_end_with_parent,
            )
        child = Child(name, process, log)
        self._children.append(child)
        return child

    def check(self) -> None:
        """Raise DemoError if one has failed; one that has finished is fine."""
        for child in self._children:
            code = child.process.poll()
            if code is not None and code != 0:
                raise DemoError(f"{child.name} ended with code {code}: {child.last_words()}")

    def wait_until(self, what: str, ready: Callable[[], bool], timeout_s: float = 20.0) -> None:
        """Wait for something that a child does. Raises DemoError if it fails or takes too long."""
        deadline_s = time.monotonic() + timeout_s
        while not ready():
            self.check()
            if time.monotonic() > deadline_s:
                raise DemoError(f"{what} did not happen within {timeout_s:.0f} s")
            time.sleep(0.02)

    def __enter__(self) -> Children:
        return self

    def __exit__(self, *_: object) -> None:
        for child in reversed(self._children):
            child.stop()


def _end_with_parent() -> None:
    _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)

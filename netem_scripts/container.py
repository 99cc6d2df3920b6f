"""A program in a network of its own, of which nothing is left however it ends.

The network, process and mount namespaces are unnamed: they live as long as the processes in them. The
processes form a chain, each of which the kernel kills with the one before: ours, the holder (which made the
namespaces), the first process of the process namespace (whose death ends all others in it), and the program.
"""

from __future__ import annotations

import ctypes
import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

_CLONE_NEWNS, _CLONE_NEWUSER, _CLONE_NEWPID, _CLONE_NEWNET = 0x20000, 0x10000000, 0x20000000, 0x40000000
_MS_REC_PRIVATE = 0x4000 | 0x40000
_PR_SET_PDEATHSIG = 1  # prctl(2): the kernel signals the child when its parent dies
_READY, _GO = b"ready", b"go"
_START_TIMEOUT_S = 20.0

_libc = ctypes.CDLL(None, use_errno=True)


class ContainerError(Exception):
    """The namespaces cannot be made, or a command cannot be run; the message says which."""


class Container:
    """One side: its namespaces, and the program in them once it has been let go.

    The holder is `python -m netem_scripts hold`; it hands over what `prepare` opened inside (a TUN device),
    or nothing.
    """

    def __init__(self, name: str, command: Sequence[str], prepare: Sequence[str] = ()) -> None:
        self.name = name
        self._ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._ours.settimeout(_START_TIMEOUT_S)
        arguments = [str(theirs.fileno()), str(os.getpid()), *prepare, "--", *command]
        package_home = str(Path(__file__).resolve().parents[1])
        path = os.pathsep.join(filter(None, [package_home, os.environ.get("PYTHONPATH")]))
        self.process = subprocess.Popen(
            [sys.executable, "-m", "netem_scripts", "hold", *arguments],
            pass_fds=[theirs.fileno()],
            env={**os.environ, "PYTHONPATH": path},
        )
        theirs.close()

    @property
    def pid(self) -> int:
        """The holder's: /proc/PID/ns/net is the side's network."""
        return self.process.pid

    def wait_ready(self) -> int | None:
        """Wait until the namespaces are there; the file descriptor that was opened inside. ContainerError."""
        try:
            message, descriptors, _, _ = socket.recv_fds(self._ours, 4096, 1)
        except OSError as error:
            raise ContainerError(f"{self.name}: the namespaces were not ready in time: {error}.") from error
        if message != _READY:
            reason = message.decode(errors="replace") or "the holder ended"
            raise ContainerError(f"{self.name}: the namespaces cannot be made: {reason}.")
        return descriptors[0] if descriptors else None

    def go(self) -> None:
        """Let the program begin."""
        self._ours.send(_GO)

    def stop(self, timeout_s: float = 3.0) -> int:
        """Ask the program to end, then make it; its exit code, 128 + n if signal n ended it."""
        self._ours.close()
        if self.process.poll() is None:
            self.process.terminate()
            try:
                self.process.wait(timeout_s)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()
        code = self.process.returncode
        return code if code >= 0 else 128 - code


def hold(arguments: Sequence[str], prepare: Callable[[Sequence[str]], int | None]) -> int:
    """The holder's life: make the namespaces, tell, wait for leave, run the program, return its exit code.

    arguments: as Container passes them; `prepare` gets those of its own, inside the namespaces.
    """
    die_with_parent(int(arguments[1]))
    split = arguments.index("--")
    channel = socket.socket(fileno=int(arguments[0]))
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(
            number, signal.SIG_IGN
        )  # the program hears of Ctrl-C itself; SIGTERM is passed on later
    try:
        _unshare()
        descriptor = prepare(arguments[2:split])
    except OSError as error:
        channel.send(str(error).encode())
        return 1
    socket.send_fds(channel, [_READY], [] if descriptor is None else [descriptor])
    if descriptor is not None:
        os.close(descriptor)
    if channel.recv(16) != _GO:
        return 1
    channel.close()
    alive, ours = os.pipe()  # the first process cannot see our id: it hears of our death by the pipe's end
    first = os.fork()
    if first == 0:
        os.close(ours)
        die_with_parent(None)
        if select.select([alive], [], [], 0)[0]:
            os._exit(1)
        os.close(alive)
        os._exit(_first_process(arguments[split + 1 :]))
    signal.signal(signal.SIGTERM, lambda *_: os.kill(first, signal.SIGTERM))
    return exit_code(os.waitpid(first, 0)[1])


def die_with_parent(parent: int | None) -> None:
    """Have the kernel kill this process with its parent, whose id is given to see if it is dead already."""
    _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if parent is not None and os.getppid() != parent:
        sys.exit(1)


def exit_code(status: int) -> int:
    """A wait status as a shell tells it."""
    code = os.waitstatus_to_exitcode(status)
    return code if code >= 0 else 128 - code


def mount(source: str, target: str, kind: str, flags: int = 0) -> None:
    """mount(2). Raises OSError."""
    if _libc.mount(source.encode(), target.encode(), kind.encode(), flags, None):
        raise OSError(ctypes.get_errno(), f"mount of {target}: {os.strerror(ctypes.get_errno())}")


def _unshare() -> None:
    user, group = os.geteuid(), os.getegid()
    flags = _CLONE_NEWNS | _CLONE_NEWPID | _CLONE_NEWNET | (_CLONE_NEWUSER if user else 0)
    if _libc.unshare(flags):
        raise OSError(ctypes.get_errno(), f"unshare: {os.strerror(ctypes.get_errno())}")
    if user:
        Path("/proc/self/setgroups").write_text("deny")
        Path("/proc/self/uid_map").write_text(f"0 {user} 1")
        Path("/proc/self/gid_map").write_text(f"0 {group} 1")
    mount("none", "/", "none", _MS_REC_PRIVATE)


def _first_process(command: Sequence[str]) -> int:
    """Process 1 of the namespace: start the program, reap what it leaves, end with it."""
    mount("proc", "/proc", "proc")
    program = os.fork()
    if program == 0:
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_DFL)
        try:
            os.execvp(command[0], list(command))
        except OSError as error:
            print(f"link: {command[0]}: {error.strerror}", file=sys.stderr, flush=True)
        os._exit(127)
    signal.signal(signal.SIGTERM, lambda *_: os.kill(-1, signal.SIGTERM))
    while True:
        pid, status = os.wait()
        if pid == program:
            return exit_code(status)

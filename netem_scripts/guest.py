"""A command in a real kernel of its own: user-mode Linux with the host's files, for hosts without sch_netem.

Debian's `user-mode-linux` and `kmod` (tools/install_guest.sh). The guest ends with the command, or when its
time is over; its processes on the host end with ours, however that ends. Nothing is left on the host's disk
but what the command writes there itself.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
from collections.abc import Sequence

from .container import Container, mount

KERNEL = "linux.uml"
_MEMORY = "1024M"
_BOOT_S = 30.0  # it takes 1 to 3 s
_GRACE_S = 10  # from the request to end to the kill: the command takes its own link down in it
_KILLED = 137  # as the shell has it
_NO_CODE = 125  # the guest ended before the command did
_DRAIN_S = 2  # how long output may take after the kernel's end
TIMED_OUT = 124  # as timeout(1) has it
_MODULES = ("net/sched/sch_netem", "drivers/net/veth")
_ENVIRONMENT = ("PATH", "HOME", "LANG", "VIRTUAL_ENV", "PYTHONPATH", "PYTHONDONTWRITEBYTECODE")


class GuestError(Exception):
    """The guest cannot be booted here; the message says what to install."""


def check_guest() -> None:
    """Raise GuestError when a part is missing."""
    for program, package in ((KERNEL, "user-mode-linux"), ("insmod", "kmod"), ("ip", "iproute2")):
        if shutil.which(program, path=f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin") is None:
            raise GuestError(
                f"The guest needs {program}: apt-get install {package} (or run tools/install_guest.sh)."
            )


def run_guest(command: Sequence[str], timeout_s: float) -> int:
    """Run a command in the guest, in this folder; its output is ours, its exit code is returned.

    After timeout_s, counted from the boot, it is asked to end, killed if it does not, and the code is 124.
    Raises GuestError, ContainerError.
    """
    check_guest()
    boot = Container("guest", ["sh", "-c", _boot_script(_init_script(command, timeout_s))], ("guest",))
    try:
        boot.wait_ready()
        boot.go()
        return boot.process.wait(timeout_s + _GRACE_S + _BOOT_S)
    except subprocess.TimeoutExpired:
        return TIMED_OUT
    finally:
        boot.stop(timeout_s=0.0)


def prepare_guest() -> None:
    """Inside the namespaces: memory for the kernel, and a folder that only the guest and its boot see."""
    mount("tmpfs", "/dev/shm", "tmpfs")  # the guest's memory; where noexec or small, it would not boot
    mount("tmpfs", "/run", "tmpfs")


def _boot_script(init: str) -> str:
    """What runs on the host.

    The pipes keep the kernel from making our own output non-blocking. What the kernel leaves behind when it
    is killed holds them open, hence the bound on the wait for their ends.
    """
    kernel = (
        f"{KERNEL} mem={_MEMORY} rootfstype=hostfs rootflags=/ rw init=/run/init uml_dir=/run/ umid=guest "
        "con=null con0=null,fd:5 ssl=null ssl0=null,fd:1 ssl1=null,fd:2 quiet loglevel=2 panic=1"
    )
    return (
        f"printf %s {shlex.quote(init)} >/run/init; chmod +x /run/init; export TMPDIR=/dev/shm\n"
        "mkfifo /run/out /run/err; cat </run/out & out=$!; cat </run/err >&2 & err=$!\n"
        f"{kernel} </dev/null >/run/out 2>/run/err 5>/run/console\n"
        f"(sleep {_DRAIN_S}; kill $out $err) 2>/dev/null & wait $out $err 2>/dev/null\n"
        f"[ -s /run/code ] || {{ cat /run/console >&2; echo {_NO_CODE} >/run/code; }}\n"
        "exit $(cat /run/code)\n"
    )


def _init_script(command: Sequence[str], timeout_s: float) -> str:
    """What the guest runs as its first process. /run is the boot's, by hostfs: the exit code goes there."""
    exports = [
        f"export {name}={shlex.quote(os.environ[name])}" for name in _ENVIRONMENT if name in os.environ
    ]
    modules = " ".join(f"/usr/lib/uml/modules/$(uname -r)/kernel/{name}.ko" for name in _MODULES)
    return "\n".join(
        [
            "#!/bin/sh",
            *exports,
            "export PATH=$PATH:/usr/sbin:/sbin TMPDIR=/dev/shm",  # so that nothing temporary is the host's
            "mount -t proc proc /proc; mount -t sysfs sysfs /sys",
            "mkdir -p /dev/shm /dev/pts; mount -t tmpfs tmpfs /dev/shm; mount -t devpts devpts /dev/pts",
            "for line in 0 1; do stty -F /dev/ttyS$line raw -echo; done",
            f"for module in {modules}; do insmod $module; done",
            "ip link set lo up",
            f"cd {shlex.quote(os.getcwd())}",
            "uptime_s() { cut -d. -f1 /proc/uptime; }; began_s=$(uptime_s)",
            f"timeout -k {_GRACE_S} {timeout_s:g} {shlex.join(command)} </dev/null >/dev/ttyS0 2>/dev/ttyS1",
            f"code=$?; late_s=$(($(uptime_s) - began_s - {timeout_s:.0f}))",
            # a command that had to be killed has its time over all the same
            f"[ $code = {_KILLED} ] && [ $late_s -ge 0 ] && code={TIMED_OUT}",
            "echo $code >/run/code",
            "sleep 0.2",  # the lines drain
            "echo o >/proc/sysrq-trigger; sleep 60",
            "",
        ]
    )

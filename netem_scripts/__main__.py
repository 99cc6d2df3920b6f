"""`python -m netem_scripts hold | guard ...`: what we start ourselves; people use `straitlink link`."""

from __future__ import annotations

import sys
from collections.abc import Sequence


def prepare(arguments: Sequence[str]) -> int | None:
    """What a holder does in its namespaces: `tun ADDRESS` opens a device, `guest` mounts, nothing is bare."""
    if arguments and arguments[0] == "tun":
        from .tun import prepare_tun

        return prepare_tun(arguments[1:])
    if arguments:
        from .guest import prepare_guest

        prepare_guest()
    return None


def main(arguments: Sequence[str]) -> int:
    """The exit code of the part that the first argument names."""
    if arguments[0] == "guard":
        from .tc import guard

        return guard(arguments[1:])
    from .container import hold

    return hold(arguments[1:], prepare)


if __name__ == "__main__":
    if sys.argv[1:2] not in (["hold"], ["guard"]):
        sys.exit(__doc__)
    sys.exit(main(sys.argv[1:]))

"""`python -m netem_scripts hold ...` is what Container starts; people use `straitlink link`."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from .container import hold


def prepare(arguments: Sequence[str]) -> int | None:
    """What is opened inside the namespaces: `tun ADDRESS` a device, nothing a bare network."""
    if not arguments:
        return None
    from .tun import prepare_tun

    return prepare_tun(arguments[1:])


if __name__ == "__main__":
    if sys.argv[1:2] != ["hold"]:
        sys.exit(__doc__)
    sys.exit(hold(sys.argv[2:], prepare))

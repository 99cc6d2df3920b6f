"""Kernels over millions of points: Numba, without the interpreter's lock, machine code kept on disk."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba

Kernel = TypeVar("Kernel", bound=Callable[..., Any])


def compiled(kernel: Kernel) -> Kernel:
    """Compile at the first call; other threads run on while it computes."""
    try:
        return cast(Kernel, numba.njit(cache=True, nogil=True)(kernel))
    except RuntimeError:  # nowhere to keep it: neither beside the source nor in the home
        return cast(Kernel, numba.njit(nogil=True)(kernel))

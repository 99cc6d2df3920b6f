"""Numba where it is installed, plain Python where it is not; the kernels run unchanged under both.

A kernel is written in the intersection of the two: whole numbers that fit 64 signed bits, doubles with
+, -, * and / in a written order, and flat sequences of state (arrays under Numba, lists under Python,
which indexes them faster). So robot and operator agree on every bit whatever they have installed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

try:
    import numba
except ImportError:
    IS_COMPILED = False
else:
    IS_COMPILED = not numba.config.DISABLE_JIT  # type: ignore[attr-defined]

Ints: TypeAlias = NDArray[np.int64]
Doubles: TypeAlias = NDArray[np.float64]
Kernel = TypeVar("Kernel", bound=Callable[..., Any])


def compiled(kernel: Kernel) -> Kernel:
    """Compile at the first call and keep the machine code on disk, if Numba is there."""
    if not IS_COMPILED:
        return kernel
    try:
        return cast(Kernel, numba.njit(cache=True)(kernel))
    except RuntimeError:  # nowhere to keep it: neither beside the source nor in the home
        return cast(Kernel, numba.njit(kernel))


def inlined(kernel: Kernel) -> Kernel:
    """Compile into whatever kernel calls it: a call that hands over a model's dozen arrays costs more
    than most of what is done with them."""
    return cast(Kernel, numba.njit(forceinline=True)(kernel)) if IS_COMPILED else kernel


def ints(values: ArrayLike) -> Ints:
    """Whole numbers as the kernels take them: flat, writable, 64 bits."""
    array = np.array(values, dtype=np.int64).reshape(-1)
    return array if IS_COMPILED else cast(Ints, array.tolist())


def doubles(values: ArrayLike) -> Doubles:
    """Doubles as the kernels take them: flat, writable."""
    array = np.array(values, dtype=np.float64).reshape(-1)
    return array if IS_COMPILED else cast(Doubles, array.tolist())


def octets(data: bytes) -> NDArray[np.uint8]:
    """Bytes as the kernels take them: writable, indexed one by one."""
    buffer = bytearray(data)
    return np.frombuffer(buffer, np.uint8) if IS_COMPILED else cast(NDArray[np.uint8], buffer)

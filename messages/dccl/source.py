"""Python source under construction: lines, blocks, fresh names and the objects that the code refers to."""

from __future__ import annotations

import keyword
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from operator import lshift
from typing import Any

PACKED_AT_ONCE = 64  # elements; longer arrays are packed in halves, since shifting long integers is slow


class Source:
    """The body of one function, and its globals."""

    def __init__(self) -> None:
        self.globals: dict[str, Any] = {}
        self._lines: list[str] = []
        self._depth = 1
        self._names = 0

    def line(self, text: str) -> None:
        """Add a line at the current depth."""
        self._lines.append("    " * self._depth + text)

    @contextmanager
    def block(self, header: str) -> Iterator[None]:
        """A header such as "if x:", and what is added inside the `with`, indented."""
        self.line(header)
        self._depth += 1
        count = len(self._lines)
        yield
        if len(self._lines) == count:
            self.line("pass")
        self._depth -= 1

    def name(self, prefix: str) -> str:
        """A local name that nothing else has."""
        self._names += 1
        return f"{prefix}{self._names}"

    def constant(self, prefix: str, value: Any) -> str:
        """A global name for an object."""
        name = self.name(f"_{prefix}")
        self.globals[name] = value
        return name

    def text(self, name: str, arguments: str) -> str:
        """The function's source."""
        return "\n".join([f"def {name}({arguments}):", *self._lines, ""])

    def compile(self, name: str, arguments: str, **names: Any) -> Callable[..., Any]:
        """The function, with some more globals."""
        namespace = {**self.globals, **names}
        exec(compile(self.text(name, arguments), f"<dccl {name}>", "exec"), namespace)
        return namespace[name]  # type: ignore[no-any-return]


def attribute(owner: str, name: str) -> str:
    """The expression for a message's field, which may be named like a keyword."""
    return f"getattr({owner}, {name!r})" if keyword.iskeyword(name) else f"{owner}.{name}"


def assignment(owner: str, name: str, value: str) -> str:
    """The statement that sets a message's field."""
    if keyword.iskeyword(name):
        return f"setattr({owner}, {name!r}, {value})"
    return f"{owner}.{name} = {value}"


def shifts(bits: int, count: int) -> tuple[int, ...]:
    """Where the elements of an array start."""
    return tuple(range(0, bits * count, bits)) if bits else (0,) * count


@lru_cache(maxsize=4096)
def ones(bits: int, count: int) -> int:
    """The integer with a 1 at the start of each element: what a bias of 1 per element adds up to."""
    return sum(1 << shift for shift in shifts(bits, count))


def pack(values: Sequence[int], bits: int, bias: int) -> int:
    """An array of integers, less the bias, as one integer with the first element lowest."""
    count = len(values)
    if count <= PACKED_AT_ONCE:
        packed: int = sum(map(lshift, values, shifts(bits, count)))
        return packed - bias * ones(bits, count)
    half = count // 2
    return pack(values[:half], bits, bias) | pack(values[half:], bits, bias) << half * bits


def unpack(packed: int, bits: int, count: int) -> list[int]:
    """The elements of an array; bits above it are ignored."""
    if count <= PACKED_AT_ONCE:
        mask = (1 << bits) - 1
        return [packed >> shift & mask for shift in shifts(bits, count)]
    half = count // 2
    low = packed & ((1 << half * bits) - 1)
    return unpack(low, bits, half) + unpack(packed >> half * bits, bits, count - half)

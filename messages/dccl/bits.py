"""Where the bits of a message go while its code is being written: one class for each direction.

A message is one long integer, its first field lowest. As long as all fields have a fixed width, places are
constants in the code; from the first field of variable size on, they are relative to a variable.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from messages.dccl.source import Source

_WRITTEN_AT_ONCE = 64  # summed in integers of three digits at most
_READ_AT_ONCE = 120  # then taken apart in integers of four digits


class BitWriter:
    """An integer under construction: the variable `value`, and `size` once its size varies."""

    def __init__(self, source: Source) -> None:
        self.value = source.name("a")
        self.size = source.name("s")
        self.at: int | None = 0  # its bits so far; None once only the variable knows
        self.is_assigned = False
        self._source = source
        self._pieces: list[str] = []
        self._bias = 0
        self._pending = 0

    def put(self, value: str, width: int, bias: int = 0) -> None:
        """Append an integer of `width` bits, less a constant bias."""
        if width == 0:
            return
        if self._pending + width > _WRITTEN_AT_ONCE:
            self.flush()
        self._pieces.append(f"({value} << {self._pending})" if self._pending else value)
        self._bias += bias << self._pending
        self._pending += width

    def skip(self, width: int) -> None:
        """Append zero bits."""
        self._pending += width

    def flush(self) -> None:
        """Write the code for what has been put."""
        if self._pieces:
            value = " + ".join(self._pieces)
            if self._bias:
                value = f"{value} - {self._bias}" if self._bias > 0 else f"{value} + {-self._bias}"
            shift = self.size if self.at is None else self.at
            shifted = f"({value}) << {shift}" if shift else value
            self._source.line(f"{self.value} {'+=' if self.is_assigned else '='} {shifted}")
            self.is_assigned = True
        if self.at is not None:
            self.at += self._pending
        elif self._pending:
            self._source.line(f"{self.size} += {self._pending}")
        self._pieces, self._bias, self._pending = [], 0, 0

    def vary(self) -> None:
        """From here on the size is a variable."""
        self.flush()
        if self.at is not None:
            self._source.line(f"{self.size} = {self.at}")
            self.at = None
        self._assign()

    def finish(self, is_fixed: bool) -> None:
        """Let the variables hold what has been put. is_fixed: nobody will read the size."""
        self.flush()
        self._assign()
        if not is_fixed:
            self.vary()

    def append(self, inner: BitWriter, width: int | None) -> None:
        """Append a finished integer; width: its size, None where its own variable knows it."""
        if width is not None:
            self.put(inner.value, width)
            return
        self.vary()
        self._source.line(f"{self.value} += {inner.value} << {self.size}")
        self._source.line(f"{self.size} += {inner.size}")

    def _assign(self) -> None:
        if not self.is_assigned:
            self._source.line(f"{self.value} = 0")
            self.is_assigned = True


class BitReader:
    """Reads from the integer `x` at a known place, or from the bit `s` on."""

    def __init__(self, source: Source) -> None:
        self.is_varying = False
        self._source = source
        self._at = 0  # place of the next bit, from the bit `s` if is_varying
        self._piece: tuple[str, int] | None = None  # an integer's name, and the place of its first bit

    def place(self) -> str:
        """An expression for the place of the next bit."""
        if not self.is_varying:
            return str(self._at)
        return f"s + {self._at}" if self._at else "s"

    def read(self, width: int, is_alone: bool = False) -> str:
        """An expression for the next bits; moves on. is_alone: too many to share a piece."""
        if width == 0:
            return "0"
        place, self._at = self._at, self._at + width
        mask = (1 << width) - 1
        if is_alone or width > _READ_AT_ONCE:
            return f"({self._from(place)} & {mask})"
        if self._piece is None or place + width > self._piece[1] + _READ_AT_ONCE:
            name = self._source.name("p")
            self._source.line(f"{name} = {self._from(place)} & {(1 << _READ_AT_ONCE) - 1}")
            self._piece = name, place
        name, start = self._piece
        return f"({name} >> {place - start} & {mask})" if place > start else f"({name} & {mask})"

    def skip(self, width: int) -> None:
        """Leave bits out."""
        self.jump(self._at + width)

    def jump(self, place: int) -> None:
        """Go on from another place."""
        self._at, self._piece = place, None

    def vary(self) -> None:
        """From here on the place is the variable s."""
        if not self.is_varying:
            self._source.line(f"s = {self._at}")
        elif self._at:
            self._source.line(f"s += {self._at}")
        self.is_varying = True
        self.jump(0)

    @contextmanager
    def branch(self, header: str) -> Iterator[None]:
        """A block that may or may not run: the place is variable before it and after it."""
        self.vary()
        with self._source.block(header):
            yield
            self.vary()

    def _from(self, place: int) -> str:
        """An expression for all bits from a place on."""
        if self.is_varying:
            return f"x >> s + {place}" if place else "x >> s"
        return f"x >> {place}" if place else "x"

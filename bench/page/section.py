"""What a part of the page is made of, whatever it is rendered to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

INTRODUCTION = (
    "Messages between a robot and its operator over links that are thin, slow, changing and broken. Every "
    "part says what was run and on what. Figures of virtual time are exact and the same on any machine; ages "
    "and CPU times are those of the machine that is named, where a load beyond the number of its cores means "
    "that others used it too. Where another stack does better, the first table says so.\n\n"
    "`make bench` runs what needs no root, `make bench-peers` the other stacks."
)


@dataclass(frozen=True, slots=True)
class Table:
    """The first column is text, the others are figures."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""


@dataclass(frozen=True, slots=True)
class Bars:
    """One bar for each label; None draws nothing. unit: what stands on the axis."""

    title: str
    labels: Sequence[str]
    values: Sequence[float | None]
    unit: str
    logarithmic: bool = False
    ranges: Sequence[tuple[float, float] | None] = ()


@dataclass(frozen=True, slots=True)
class Curves:
    """Lines over a common kind of x; both axes logarithmic."""

    title: str
    x_label: str
    y_label: str
    lines: dict[str, tuple[Sequence[float], Sequence[float]]]


@dataclass(frozen=True, slots=True)
class Section:
    """command: what reproduces it. provenance: of the run that is shown."""

    title: str
    lead: str
    command: str
    provenance: str
    tables: Sequence[Table]
    plots: Sequence[Bars | Curves] = field(default=())

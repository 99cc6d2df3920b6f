"""What both ends keep of a message: its lanes, and for how long each has stood still."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

MAX_DISTANCE = 63  # messages between one and its reference: 6 s at 10 Hz
HISTORY = 8  # messages before the reference that may help
WINDOW = MAX_DISTANCE + HISTORY + 1  # messages that either end keeps
MAX_CALM = 7


@dataclass(frozen=True, slots=True)
class Sample:
    """One message. calm: per lane, how many references in a row had the same value, at most MAX_CALM.

    root: the number of the message without reference from which it descends; of several, the oldest.
    leans: whether its lanes were foretold from each other.
    """

    lanes: tuple[int, ...]
    calm: tuple[int, ...]
    root: int
    leans: bool


@dataclass(frozen=True, slots=True)
class References:
    """What a message is coded against. distance: how many numbers before it the reference is.

    history: (how many numbers before the reference, the sample) of what else the receiver holds, near first.
    """

    distance: int
    reference: Sample
    history: tuple[tuple[int, Sample], ...]


def make_sample(number: int, lanes: Sequence[int], known: References | None, leans: bool) -> Sample:
    """A message's sample, with what its reference tells of standing still."""
    if known is None:
        return Sample(tuple(lanes), (0,) * len(lanes), number, leans=False)
    reference = known.reference
    root = min([reference.root, *(sample.root for _, sample in known.history)])
    calm = tuple(
        min(MAX_CALM, calm + 1) if now == then else 0
        for now, then, calm in zip(lanes, reference.lanes, reference.calm, strict=True)
    )
    return Sample(tuple(lanes), calm, root, leans)

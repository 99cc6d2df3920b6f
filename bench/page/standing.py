"""Where another stack is ahead of ours, said by the figures and not by us."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from bench.peers.summary import Row, Spread

OURS = "straitlink"


@dataclass(frozen=True, slots=True)
class Figure:
    """What stacks are compared by. margin: as share of ours, what two runs of one stack may differ by."""

    name: str
    unit: str
    of: Callable[[Row], Spread]
    more_is_better: bool
    margin: float


def _delivered(topic: str) -> Callable[[Row], Spread]:
    return lambda row: row.topics[topic]["delivered"]


def _age(topic: str, figure: str) -> Callable[[Row], Spread]:
    return lambda row: row.topics[topic][figure]


FIGURES = (
    Figure("heartbeats delivered", "", _delivered("heartbeat"), True, 0.01),
    Figure("heartbeat's age p50", " ms", _age("heartbeat", "age_p50_ms"), False, 0.03),
    Figure("heartbeat's age p95", " ms", _age("heartbeat", "age_p95_ms"), False, 0.03),
    Figure("joints delivered", "", _delivered("joints"), True, 0.01),
    Figure("joints' age p95", " ms", _age("joints", "age_p95_ms"), False, 0.03),
    Figure("images in time", "", lambda row: row.topics["images"]["in_window"], True, 0.01),
    Figure("images' age p50", " ms", _age("images", "age_p50_ms"), False, 0.03),
    Figure("commands delivered", "", _delivered("commands"), True, 0.01),
    Figure("commands' age p95", " ms", _age("commands", "age_p95_ms"), False, 0.03),
)


@dataclass(frozen=True, slots=True)
class Behind:
    """One figure in which another stack's median is better. its_heartbeats, its_images: what it paid."""

    place: str
    figure: str
    ours: str
    theirs: str
    peer: str
    its_heartbeats: str
    its_images: str


def behind(rows: Sequence[Row]) -> Iterator[Behind]:
    """Each figure of each band in which a stack beats ours by more than the margin."""
    for ours in (r for r in rows if r.peer == OURS):
        place = (ours.load, ours.profile, ours.window)
        for row in rows:
            if row.peer != OURS and (row.load, row.profile, row.window) == place:
                yield from (_line(ours, row, figure) for figure in FIGURES if _is_ahead(ours, row, figure))


def _is_ahead(ours: Row, row: Row, figure: Figure) -> bool:
    our, their = figure.of(ours), figure.of(row)
    if not their.runs:
        return False
    if not our.runs:
        return True
    gain = their.median - our.median
    return (gain if figure.more_is_better else -gain) > figure.margin * our.median


def _line(ours: Row, row: Row, figure: Figure) -> Behind:
    return Behind(
        f"{ours.load}, {ours.profile}, {ours.window}",
        figure.name,
        figure.of(ours).text(".0f") + figure.unit,
        figure.of(row).text(".0f") + figure.unit,
        row.peer,
        _share(row, "heartbeat", "delivered"),
        _share(row, "images", "in_window"),
    )


def _share(row: Row, topic: str, figure: str) -> str:
    return f"{row.topics[topic][figure].median:.0f} of {row.topics[topic]['offered'].median:.0f}"

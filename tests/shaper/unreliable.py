"""Links whose every misdeed Hypothesis has chosen."""

from __future__ import annotations

from collections.abc import Iterator

from hypothesis import strategies as st

from tests.shaper.pair import MS, Pair

_COPIES: dict[str, tuple[int, ...]] = {
    "fine": (0,),
    "lost": (),
    "twice": (0, 30 * MS),
    "late": (35 * MS,),
    "very late": (400 * MS,),
}
FATES = st.lists(st.sampled_from(["fine", "fine", "lost", "twice", "late", "very late"]), max_size=150)
"""What becomes of each datagram of either side in turn; after the last one all is well."""


def suffer(pair: Pair, fates: list[str]) -> None:
    """From now on the link treats datagrams like this."""
    each: Iterator[str] = iter(fates)

    def copies() -> tuple[int, ...]:
        return _COPIES[next(each, "fine")]

    pair.robot.copies = pair.operator.copies = copies

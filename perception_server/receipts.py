"""What became of the views that left, and what has been shown to operators already."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

from perception_server.request_status import Stage, Status

_MAX_FOLLOWED = 128  # views whose fate is awaited, and wishes whose newest data is remembered
_TOLD = {each.value: each for each in (Stage.SENT, Stage.DELIVERED, Stage.LOST, Stage.EXPIRED)}


@dataclass(frozen=True, slots=True)
class Left:
    """A view that has gone to the bus. wish: what it shows, without the request's number."""

    request_id: int
    key: str
    wish: bytes
    size_bytes: int
    source_ns: int


class Receipts:
    """Follows views by the stamps that they left with; what was lost counts as not shown."""

    def __init__(self, tell: Callable[[Status], None]) -> None:
        self._tell = tell
        self._followed: OrderedDict[tuple[str, int, int], Left] = OrderedDict()
        self._shown: OrderedDict[bytes, tuple[int, int]] = OrderedDict()

    def on_left(self, left: Left, capture_ns: int, sequence: int) -> None:
        """A view has gone to the bus with this stamp."""
        self._followed[left.key, capture_ns, sequence] = left
        self._shown.pop(left.wish, None)
        self._shown[left.wish] = left.source_ns, left.request_id
        for kept in (self._followed, self._shown):
            while len(kept) > _MAX_FOLLOWED:
                kept.popitem(last=False)

    def on_receipt(self, key: str, capture_ns: int, sequence: int, stage: str) -> None:
        """The shaper says what became of what left with this stamp."""
        left = self._followed.get((key, capture_ns, sequence))
        if left is None or stage not in _TOLD:
            return
        told = _TOLD[stage]
        if told is not Stage.SENT:
            del self._followed[key, capture_ns, sequence]
        if told in (Stage.LOST, Stage.EXPIRED):
            self._shown.pop(left.wish, None)
        self._tell(Status(left.request_id, told, key, size_bytes=left.size_bytes, source_ns=left.source_ns))

    def shown(self, wish: bytes) -> tuple[int, int] | None:
        """Newest data that a wish has shown, and by which request; None if it was lost, or never left."""
        return self._shown.get(wish)

"""What fits: the finest rung of a ladder whose view is small enough."""

from __future__ import annotations

from collections.abc import Callable

from messages.proto.straitlink.view_pb2 import VIEW_STATUS_DOES_NOT_FIT, VIEW_STATUS_REFUSED, View
from perception_server.view_codec import EncodeError
from perception_server.view_wish import Fidelity

Encode = Callable[[Fidelity], View]
_STEP = 2**0.5  # between rungs: half a bit per cell of error, or half the cells


def ladder(finest: Fidelity, worst: Fidelity) -> list[Fidelity]:
    """From the finest to the worst: the error grows first, then the resolution coarsens.

    Bytes against error to the true surface, that order costs least until the error meets the sensor's
    own noise; beyond it, resolution is the cheaper one to give up.
    """
    errors = _steps(finest.max_error_m, worst.max_error_m)
    resolutions = _steps(finest.resolution, worst.resolution)
    rungs = [Fidelity(finest.resolution, error) for error in errors]
    return rungs + [Fidelity(resolution, errors[-1]) for resolution in resolutions[1:]]


def _steps(first: float, last: float) -> list[float]:
    steps = [first]
    while steps[-1] * _STEP < last * 0.999:
        steps.append(steps[-1] * _STEP)
    if last > first:
        steps.append(last)
    return steps


def fit(
    encode: Encode,
    finest: Fidelity,
    worst: Fidelity,
    budget_bytes: int,
    request_id: int,
    draft: Encode | None = None,
) -> View:
    """The finest view within budget_bytes, found in a few encodings; else DOES_NOT_FIT with the smallest.

    A rung that a codec cannot hold (EncodeError) counts as too large. draft: a faster encoder of larger
    views to search with; what it finds is encoded anew, and the finer rungs that then fit as well.
    """
    rungs = ladder(finest, worst)
    views = _Rungs(encode, rungs, budget_bytes)
    if draft is None:
        best = _finest(views, len(rungs))
    else:
        found = _finest(_Rungs(draft, rungs, budget_bytes), len(rungs))
        best = _climbed(views, len(rungs) - 1 if found is None else found)
    if best is None:
        return _does_not_fit(views, request_id)
    view = views.at(best)
    assert view is not None
    return view


class _Rungs:
    """The views of a ladder, each encoded once."""

    def __init__(self, encode: Encode, rungs: list[Fidelity], budget_bytes: int) -> None:
        self.refusal = ""
        self.tried: dict[int, View | None] = {}
        self._encode = encode
        self._rungs = rungs
        self._budget_bytes = budget_bytes

    def at(self, rung: int) -> View | None:
        """The view, or None if its codec cannot hold it."""
        if rung not in self.tried:
            try:
                self.tried[rung] = self._encode(self._rungs[rung])
            except EncodeError as error:
                self.refusal = str(error)
                self.tried[rung] = None
        return self.tried[rung]

    def fits(self, rung: int) -> bool:
        view = self.at(rung)
        return view is not None and view.ByteSize() <= self._budget_bytes


def _finest(views: _Rungs, count: int) -> int | None:
    """The finest rung that fits, by bisection; None if the last does not."""
    if views.fits(0):
        return 0
    low, best = 0, count - 1  # low does not fit; best may
    if not views.fits(best):
        return None
    while best - low > 1:
        middle = (low + best) // 2
        low, best = (low, middle) if views.fits(middle) else (middle, best)
    return best


def _climbed(views: _Rungs, rung: int) -> int | None:
    """The last rung that fits, from `rung` to finer ones; None if it does not itself."""
    best = None
    while rung >= 0 and views.fits(rung):
        best, rung = rung, rung - 1
    return best


def _does_not_fit(views: _Rungs, request_id: int) -> View:
    sizes = [view.ByteSize() for view in views.tried.values() if view]
    if not sizes:
        return View(request_id=request_id, status=VIEW_STATUS_REFUSED, error=f"resolution_m: {views.refusal}")
    return View(
        request_id=request_id,
        status=VIEW_STATUS_DOES_NOT_FIT,
        error=f"does not fit: smallest is {min(sizes)} bytes",
        smallest_bytes=min(sizes),
    )

"""What fits: the finest rung of a ladder whose view is small enough."""

from __future__ import annotations

from collections.abc import Callable

from messages.proto.straitlink.view_pb2 import VIEW_STATUS_DOES_NOT_FIT, VIEW_STATUS_REFUSED, View
from perception_server.view_codec import EncodeError
from perception_server.view_wish import Fidelity

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
    encode: Callable[[Fidelity], View], finest: Fidelity, worst: Fidelity, budget_bytes: int, request_id: int
) -> View:
    """The finest view within budget_bytes, found in a few encodings; else DOES_NOT_FIT with the smallest.

    A rung that a codec cannot hold (EncodeError) counts as too large.
    """
    rungs = ladder(finest, worst)
    tried: dict[int, View | None] = {}
    refusal = ""

    def view_at(rung: int) -> View | None:
        nonlocal refusal
        if rung not in tried:
            try:
                tried[rung] = encode(rungs[rung])
            except EncodeError as error:
                refusal = str(error)
                tried[rung] = None
        return tried[rung]

    def fits(rung: int) -> bool:
        view = view_at(rung)
        return view is not None and view.ByteSize() <= budget_bytes

    if fits(0):
        best = 0
    else:
        low, best = 0, len(rungs) - 1  # low does not fit; best may
        if not fits(best):
            return _does_not_fit([view for view in tried.values() if view], refusal, request_id)
        while best - low > 1:
            middle = (low + best) // 2
            low, best = (low, middle) if fits(middle) else (middle, best)
    view = tried[best]
    assert view is not None
    return view


def _does_not_fit(views: list[View], refusal: str, request_id: int) -> View:
    if not views:
        return View(request_id=request_id, status=VIEW_STATUS_REFUSED, error=f"resolution_m: {refusal}")
    smallest = min(view.ByteSize() for view in views)
    return View(
        request_id=request_id,
        status=VIEW_STATUS_DOES_NOT_FIT,
        error=f"does not fit: smallest is {smallest} bytes",
        smallest_bytes=smallest,
    )

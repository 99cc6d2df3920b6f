"""The answer to an image request: which camera, which frame, then its picture to the budget."""

from __future__ import annotations

from messages.proto.straitlink.view_pb2 import (
    VIEW_STATUS_NO_DATA,
    VIEW_STATUS_REFUSED,
    Image,
    ImageRequest,
)
from perception_server.camera_model import CameraModel, camera_model
from perception_server.errors import NoDataError, RequestError
from perception_server.history import HistorySnapshot
from perception_server.image_wish import ImageWish, image_wish
from perception_server.images import render_image
from perception_server.pictures import CameraFrame

MAX_OFF_NS = 1_000_000_000  # from the time asked for to the nearest frame


def answer_image(request: ImageRequest, history: HistorySnapshot, budget_bytes: int) -> Image:
    """The picture, in at most budget_bytes, or why there is none; never raises for what a peer asks."""
    try:
        wish = image_wish(request)
        frame = frame_of(wish, history)
        camera = None if wish.look is None else _camera(frame, history)
        return render_image(wish, frame, camera, budget_bytes, request.request_id)
    except RequestError as error:
        return Image(request_id=request.request_id, status=VIEW_STATUS_REFUSED, error=str(error))
    except NoDataError as error:
        return Image(request_id=request.request_id, status=VIEW_STATUS_NO_DATA, error=str(error))


def frame_of(wish: ImageWish, history: HistorySnapshot) -> CameraFrame:
    """The newest frame of the camera, or the one nearest to the time asked for.

    Without a source it is the only camera, or the one that the preset's name begins with. Raises
    RequestError or NoDataError.
    """
    frames = history.cameras.get(_source(wish, history), ())
    if not frames:
        raise NoDataError(f"{wish.source or 'the cameras'}: no frame has come yet")
    if wish.at_ns is None:
        return frames[-1]
    at_ns = wish.at_ns
    nearest = min(frames, key=lambda frame: abs(frame.capture_ns - at_ns))
    off_ns = nearest.capture_ns - at_ns
    if abs(off_ns) > MAX_OFF_NS:
        raise NoDataError(f"at_ns = {at_ns}: the nearest frame kept is {off_ns / 1e9:+.1f} s from it")
    return nearest


def _source(wish: ImageWish, history: HistorySnapshot) -> str:
    names = sorted(history.cameras)
    if wish.source:
        if names and wish.source not in names:
            raise RequestError(f"source = {wish.source!r}: must be one of {', '.join(names)}")
        return wish.source
    meant = [name for name in names if name == wish.camera_hint]
    if len(names) > 1 and not meant:
        raise RequestError(f"source: is missing: must be one of {', '.join(names)}")
    return (meant or names or [""])[0]


def _camera(frame: CameraFrame, history: HistorySnapshot) -> CameraModel | None:
    found = history.calibrations.get(frame.frame_id)
    if found is None:
        return None
    return camera_model(found.width_px, found.height_px, found.distortion_model, found.d, found.k)

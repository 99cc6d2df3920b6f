"""From a request to its view: the whole pipeline on one screen. A pure function of history and budget."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from messages.proto.straitlink.view_pb2 import (
    VIEW_STATUS_NO_DATA,
    VIEW_STATUS_REFUSED,
    View,
    ViewRequest,
    ViewStatus,
)
from perception_server import stereo
from perception_server.budget import fit
from perception_server.compact_pose import compact_pose, pose_matrix
from perception_server.errors import NoDataError, PoseError, RequestError
from perception_server.frames import FloatArray
from perception_server.history import HistorySnapshot
from perception_server.point_ring import MIXED, ON_ROBOT, BlockView
from perception_server.region import Region, ViewPoints, Window, collect
from perception_server.scan_geometry import ScanPlacement
from perception_server.sweep import latest_sweep
from perception_server.view_encoding import Drawing, encode_view, has_draft
from perception_server.view_wish import Fidelity, ViewWish, view_wish

_REJECTED = {
    ViewRequest.SOURCE_LIDAR: ON_ROBOT,
    ViewRequest.SOURCE_LIDAR_FILTERED: ON_ROBOT | MIXED,
    ViewRequest.SOURCE_LIDAR_RAW: 0,
    ViewRequest.SOURCE_CLOUD: ON_ROBOT,
    ViewRequest.SOURCE_STEREO: ON_ROBOT,
}


def answer(request: ViewRequest, history: HistorySnapshot, budget_bytes: int) -> View:
    """The view in at most budget_bytes as serialised, or a reply that says why not; never raises.

    What must give for the budget is the error of coding first, then the resolution, both only as far as
    the request allows. A reply without a picture may be longer than a budget of less than 200 bytes.
    """
    try:
        wish = view_wish(request)
        budget_bytes = min(budget_bytes, wish.budget_bytes or budget_bytes)
        scene = look(wish, history)
    except RequestError as error:
        return _without_picture(request, VIEW_STATUS_REFUSED, error)
    except (NoDataError, PoseError) as error:
        return _without_picture(request, VIEW_STATUS_NO_DATA, error)

    drawing = Drawing(wish, scene.points)

    def encode(fidelity: Fidelity) -> View:
        return encode_view(scene.header, wish, drawing, fidelity)

    def draft(fidelity: Fidelity) -> View:
        return encode_view(scene.header, wish, drawing, fidelity, draft=True)

    faster = draft if has_draft(wish) else None
    return fit(encode, wish.finest, wish.worst, budget_bytes, request.request_id, faster)


@dataclass(frozen=True, slots=True)
class Scene:
    """What a request looks at, before it is drawn: the points of its region, and the view's header."""

    points: ViewPoints
    header: View


def look(wish: ViewWish, history: HistorySnapshot) -> Scene:
    """Find window, viewpoint and points. Raises NoDataError or PoseError."""
    views = _blocks(wish, history)
    window = _window(wish, views, history)
    if wish.source == ViewRequest.SOURCE_STEREO:
        placement = ScanPlacement(history.world)
        views = stereo.placed(history.disparities, window, history.tree, placement)
    pose = compact_pose(_world_from_view(wish, history, window.end_ns))
    # The rounded pose, which is the one that the operator will have.
    view_from_world: FloatArray = np.linalg.inv(pose_matrix(pose)).astype(np.float64)
    region = Region(
        view_from_world,
        *_box(wish),
        _half_planes(wish),
        *wish.range_m,
        _REJECTED[wish.source],
    )
    points = collect(views, window, region)
    if points.sources == 0:
        name = ViewRequest.Source.Name(wish.source)
        raise NoDataError(f"{name} has nothing between {window.start_ns} and {window.end_ns} ns")
    header = View(
        request_id=wish.request_id,
        format=wish.form,
        source=wish.source,
        projection=wish.projection_kind,
        world_frame_id=history.world,
        world_from_view=pose,
        newest_ns=points.end_ns,
        span_us=(points.end_ns - points.start_ns) // 1000,
        source_count=points.sources,
        point_count=len(points.points_m),
    )
    return Scene(points, header)


def newest_data_ns(wish: ViewWish, history: HistorySnapshot) -> int:
    """Capture time of the newest data of the wish's source. Raises NoDataError."""
    if wish.source == ViewRequest.SOURCE_STEREO:
        newest_ns = max((each.capture_ns for each in history.disparities), default=0)
    else:
        views = [view for view in _blocks(wish, history) if view.stop > view.first]
        newest_ns = max((int(view.block.end_ns[view.first : view.stop].max()) for view in views), default=0)
    if newest_ns == 0:
        raise NoDataError(f"{ViewRequest.Source.Name(wish.source)} has not been seen yet")
    return newest_ns


def _blocks(wish: ViewWish, history: HistorySnapshot) -> tuple[BlockView, ...]:
    return history.clouds if wish.source == ViewRequest.SOURCE_CLOUD else history.scans


def _window(wish: ViewWish, views: tuple[BlockView, ...], history: HistorySnapshot) -> Window:
    if wish.time_mode == ViewRequest.TIME_MODE_ABSOLUTE:
        return Window(*wish.absolute_ns)
    newest_ns = newest_data_ns(wish, history)
    if wish.time_mode == ViewRequest.TIME_MODE_LATEST_SWEEP:
        swept = latest_sweep(views) if wish.source not in _WITHOUT_SWEEP else None
        return swept or Window(newest_ns, newest_ns)
    end_ns = newest_ns - wish.age_ns
    return Window(end_ns - wish.window_ns, end_ns)


_WITHOUT_SWEEP = (ViewRequest.SOURCE_STEREO, ViewRequest.SOURCE_CLOUD)


def _world_from_view(wish: ViewWish, history: HistorySnapshot, time_ns: int) -> FloatArray:
    """(4, 4), from the pose that the frame had at the end of the window, or last before it."""
    world_from_frame = np.eye(4)
    if wish.frame_id and wish.frame_id != history.world:
        first_ns, last_ns = history.tree.span_ns(history.world, wish.frame_id)
        time_ns = min(max(time_ns, first_ns), last_ns)
        world_from_frame = history.tree.matrix(history.world, wish.frame_id, time_ns)
    if wish.level:
        heading = np.arctan2(world_from_frame[1, 0], world_from_frame[0, 0])
        c, s = np.cos(heading), np.sin(heading)
        world_from_frame[:3, :3] = [[c, -s, 0], [s, c, 0], [0, 0, 1]]
    product: FloatArray = world_from_frame @ wish.frame_from_view
    return product


def _box(wish: ViewWish) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """The region's box; of a height map a cell wider at its coarsest, so that its edge has neighbours."""
    if wish.form != ViewRequest.FORMAT_HEIGHT_MAP:
        return wish.low_m, wish.high_m
    margin = 2 * wish.worst.resolution
    (x0, y0, z0), (x1, y1, z1) = wish.low_m, wish.high_m
    return (x0 - margin, y0 - margin, z0), (x1 + margin, y1 + margin, z1)


def _half_planes(wish: ViewWish) -> FloatArray:
    """(P, 4): the wish's own, and of a range map what its pixels cannot see."""
    if wish.form != ViewRequest.FORMAT_RANGE_MAP:
        return wish.half_planes
    return np.concatenate([wish.projection.planes(), wish.half_planes])


def _without_picture(request: ViewRequest, status: ViewStatus.ValueType, error: Exception) -> View:
    return View(request_id=request.request_id, status=status, error=str(error))

"""Named views: those of Team MIT's perception data server at the DRC Trials (DataRequestServer.cpp).

Regions are boxes in the view's frame, which stands level at the head and turns with its heading.
"""

from __future__ import annotations

import math

from messages.proto.straitlink.view_pb2 import ViewRequest

_HEIGHT = ViewRequest.FORMAT_HEIGHT_MAP
_RANGE = ViewRequest.FORMAT_RANGE_MAP
_CLOUD = ViewRequest.FORMAT_CLOUD
_OCTREE = ViewRequest.FORMAT_OCTREE
_FILTERED = ViewRequest.SOURCE_LIDAR_FILTERED
_LAST = ViewRequest.TIME_MODE_RELATIVE

_HEAD = ViewRequest(frame_id="head", level=True, max_error_m=0.005)


def _height(
    x_m: tuple[float, float], y_m: tuple[float, float], resolution_m: float, window_s: float = 0.0
) -> ViewRequest:
    request = ViewRequest(
        format=_HEIGHT,
        min_x_m=x_m[0],
        max_x_m=x_m[1],
        min_y_m=y_m[0],
        max_y_m=y_m[1],
        min_z_m=-3.0,
        max_z_m=0.3,
        resolution_m=resolution_m,
    )
    return _with(request, window_s)


def _range(across_deg: float, up_deg: float, window_s: float, **fields: float) -> ViewRequest:
    request = ViewRequest(
        format=_RANGE,
        width_px=200,
        height_px=200,
        horizontal_fov_rad=math.radians(across_deg),
        vertical_fov_rad=math.radians(up_deg),
    )
    for name, value in fields.items():
        setattr(request, name, value)
    return _with(request, window_s)


def _workspace(yaw_deg: float) -> ViewRequest:
    """From half a metre behind the head, 20 degrees down, of what the hands can reach."""
    request = _range(100, 90, 20.0, pitch_rad=math.radians(20), yaw_rad=math.radians(yaw_deg))
    yaw = math.radians(yaw_deg)
    request.x_m, request.y_m = -0.5 * math.cos(yaw), -0.5 * math.sin(yaw)
    request.source = _FILTERED
    request.min_range_m, request.max_range_m, request.max_error_m = 0.1, 3.0, 0.01
    return _boxed(request, (0.3, 3.0), (-2.0, 2.0), (-2.0, 1.0))


def _solid(form: ViewRequest.Format.ValueType, *, near: bool) -> ViewRequest:
    """A cloud or an octree: of 5 m around at 10 cm, or of the space before the chest at 1 cm."""
    request = ViewRequest(format=form, resolution_m=0.01 if near else 0.1)
    if near:
        request.source = _FILTERED
        return _boxed(_with(request), (0.25, 2.0), (-1.0, 1.0), (-1.5, 0.3))
    return _boxed(_with(request, 20.0), (-5.0, 5.0), (-5.0, 5.0), (-5.0, 5.0))


def _with(request: ViewRequest, window_s: float = 0.0) -> ViewRequest:
    whole = ViewRequest()
    whole.CopyFrom(_HEAD)
    whole.MergeFrom(request)
    if window_s:
        whole.time_mode, whole.window_s = _LAST, window_s
    return whole


def _boxed(
    request: ViewRequest, x_m: tuple[float, float], y_m: tuple[float, float], z_m: tuple[float, float]
) -> ViewRequest:
    request.min_x_m, request.max_x_m = x_m
    request.min_y_m, request.max_y_m = y_m
    request.min_z_m, request.max_z_m = z_m
    return request


def _at_hand(frame_id: str) -> ViewRequest:
    request = _with(ViewRequest(format=_CLOUD, resolution_m=0.01), 10.0)
    request.frame_id, request.level = frame_id, False
    return _boxed(request, (-0.25, 0.25), (-0.25, 0.25), (-0.25, 0.25))


def _stereo() -> ViewRequest:
    request = _range(80, 50, 0.5)
    request.source = ViewRequest.SOURCE_STEREO
    return _boxed(request, (0.3, 10.0), (-5.0, 5.0), (-3.0, 3.0))


VIEW_PRESETS: dict[str, ViewRequest] = {
    "height_map_scene": _height((-1, 5), (-2, 2), 0.03),  # Table 1: terrain height map
    "height_map_corridor": _height((0, 10), (-1, 1), 0.05, 10.0),
    "height_map_coarse": _height((-5, 30), (-20, 20), 0.5, 10.0),
    "height_map_dense": _height((-5, 30), (-20, 20), 0.11, 20.0),
    "range_map_scene": _range(160, 90, 20.0),
    "range_map_workspace": _workspace(0),  # Table 1: workspace range map
    "range_map_workspace_left": _workspace(40),
    "range_map_workspace_right": _workspace(-40),
    "cloud_scene": _solid(_CLOUD, near=False),
    "cloud_workspace": _solid(_CLOUD, near=True),
    "cloud_left_hand": _at_hand("l_hand"),
    "cloud_right_hand": _at_hand("r_hand"),
    "octree_scene": _solid(_OCTREE, near=False),
    "octree_workspace": _solid(_OCTREE, near=True),
    "range_map_stereo": _stereo(),
}

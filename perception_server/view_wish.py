"""What a view request asks for: preset and defaults filled in, every field checked."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from messages.proto.straitlink.view_pb2 import ViewRequest
from perception_server.errors import RequestError
from perception_server.frames import FloatArray
from perception_server.height_map import Grid
from perception_server.range_map import Projection
from perception_server.request_bounds import check_bounds
from perception_server.view_codec.map_header import MAX_CELLS
from perception_server.view_presets import VIEW_PRESETS

_BOX_M = 100.0
_WORST_FACTOR = 4.0
_NS_PER_S = 1_000_000_000
_DEFAULT_WINDOW_S = 20.0

_HEIGHT_MAP = ViewRequest.FORMAT_HEIGHT_MAP
_RANGE_MAP = ViewRequest.FORMAT_RANGE_MAP
_ORTHOGRAPHIC = ViewRequest.PROJECTION_ORTHOGRAPHIC
_PERSPECTIVE = ViewRequest.PROJECTION_PERSPECTIVE
_SPHERICAL = ViewRequest.PROJECTION_SPHERICAL


@dataclass(frozen=True, slots=True)
class Fidelity:
    """How fine: cell or voxel in metres (a range map: 1 = all its pixels), and the error of coding."""

    resolution: float
    max_error_m: float


@dataclass(frozen=True, slots=True)
class ViewWish:
    """A request with everything said.

    low_m, high_m, half_planes (P, 4): the region in the view's frame. frame_from_view: (4, 4).
    finest, worst: what was asked for first, and how far a budget may push it.
    grid, projection: of a height map, of a range map, at the finest.
    """

    request_id: int
    form: ViewRequest.Format.ValueType
    source: ViewRequest.Source.ValueType
    projection_kind: ViewRequest.Projection.ValueType
    codec: ViewRequest.Codec.ValueType
    denoise: bool
    close_gaps: bool
    range_m: tuple[float, float]
    time_mode: ViewRequest.TimeMode.ValueType
    absolute_ns: tuple[int, int]
    window_ns: int
    age_ns: int
    frame_id: str
    level: bool
    frame_from_view: FloatArray
    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]
    half_planes: FloatArray
    finest: Fidelity
    worst: Fidelity
    projection: Projection
    budget_bytes: int

    def grid(self, resolution_m: float) -> Grid:
        """The height map's cells at a resolution; the box's size in whole cells, rounded."""
        columns = max(1, round((self.high_m[0] - self.low_m[0]) / resolution_m))
        rows = max(1, round((self.high_m[1] - self.low_m[1]) / resolution_m))
        return Grid(self.low_m[0], self.low_m[1], resolution_m, columns, rows)

    def shrunk_projection(self, factor: float) -> Projection:
        """The range map with so many times fewer pixels along each side."""
        columns, rows = self.projection.columns, self.projection.rows
        return replace(
            self.projection, columns=max(1, round(columns / factor)), rows=max(1, round(rows / factor))
        )


def view_wish(request: ViewRequest) -> ViewWish:
    """Fill in preset and defaults. Raises RequestError, which begins with the name of the field."""
    check_bounds(request)
    whole = _over_preset(request)
    form = whole.format
    if form == ViewRequest.FORMAT_UNSPECIFIED:
        raise RequestError("format: must be said, or a preset that says it")
    kind = _projection_kind(whole)
    low = (_or(whole, "min_x_m", -_BOX_M), _or(whole, "min_y_m", -_BOX_M), _or(whole, "min_z_m", -_BOX_M))
    high = (_or(whole, "max_x_m", _BOX_M), _or(whole, "max_y_m", _BOX_M), _or(whole, "max_z_m", _BOX_M))
    for axis, below, above in zip("xyz", low, high, strict=True):
        if below >= above:
            raise RequestError(f"max_{axis}_m = {above:g}: must be above min_{axis}_m = {below:g}")
    finest, worst = _fidelities(whole)
    wish = ViewWish(
        whole.request_id,
        form,
        whole.source or ViewRequest.SOURCE_LIDAR,
        kind,
        whole.codec,
        whole.denoise,
        whole.close_gaps,
        _range_m(whole),
        whole.time_mode or ViewRequest.TIME_MODE_LATEST_SWEEP,
        _absolute_ns(whole),
        round(_or(whole, "window_s", _DEFAULT_WINDOW_S) * _NS_PER_S),
        round(whole.age_s * _NS_PER_S),
        whole.frame_id,
        whole.level,
        _frame_from_view(whole),
        low,
        high,
        _half_planes(whole),
        finest,
        worst,
        _projection(whole, kind),
        whole.budget_bytes,
    )
    _check_size(wish)
    return wish


def _over_preset(request: ViewRequest) -> ViewRequest:
    whole = ViewRequest()
    if request.preset:
        if request.preset not in VIEW_PRESETS:
            raise RequestError(f"preset = {request.preset!r}: must be one of {', '.join(VIEW_PRESETS)}")
        whole.CopyFrom(VIEW_PRESETS[request.preset])
    said = ViewRequest()
    said.CopyFrom(request)
    for name in ("format", "source", "projection", "codec", "time_mode"):
        if getattr(said, name) == 0:
            said.ClearField(name)
    if said.half_planes:
        whole.ClearField("half_planes")
    whole.MergeFrom(said)
    return whole


def _or(request: ViewRequest, name: str, default: float) -> float:
    return float(getattr(request, name)) if request.HasField(name) else default  # type: ignore[arg-type]


def _projection_kind(request: ViewRequest) -> ViewRequest.Projection.ValueType:
    kind = request.projection
    if request.format == _RANGE_MAP:
        if kind == _ORTHOGRAPHIC:
            raise RequestError(
                "projection = PROJECTION_ORTHOGRAPHIC: a range map is perspective or spherical"
            )
        return kind or _PERSPECTIVE
    if kind not in (ViewRequest.PROJECTION_UNSPECIFIED, _ORTHOGRAPHIC):
        name = ViewRequest.Projection.Name(kind)
        raise RequestError(f"projection = {name}: only a range map has one")
    return _ORTHOGRAPHIC


def _projection(request: ViewRequest, kind: ViewRequest.Projection.ValueType) -> Projection:
    across = _or(request, "horizontal_fov_rad", math.pi / 2)
    up = _or(request, "vertical_fov_rad", math.pi / 2)
    if kind == _PERSPECTIVE:
        for name, value in (("horizontal_fov_rad", across), ("vertical_fov_rad", up)):
            if value > 3.0:  # a pixel at the edge of 172 degrees shows 14 times the middle's
                raise RequestError(f"{name} = {value:g}: must be at most 3 in perspective")
    columns = request.width_px if request.HasField("width_px") else 200
    rows = request.height_px if request.HasField("height_px") else 200
    return Projection(kind == _SPHERICAL, columns, rows, across, up)


def _fidelities(request: ViewRequest) -> tuple[Fidelity, Fidelity]:
    resolution_m = _or(request, "resolution_m", 0.03)
    error_m = _or(request, "max_error_m", 0.005)
    # Beyond a field's bound the server's own factor gives way.
    worst_resolution_m = _or(request, "worst_resolution_m", min(10.0, _WORST_FACTOR * resolution_m))
    worst_error_m = _or(request, "worst_error_m", min(1.0, _WORST_FACTOR * error_m))
    for name, worst, finest in (
        ("worst_resolution_m", worst_resolution_m, resolution_m),
        ("worst_error_m", worst_error_m, error_m),
    ):
        if worst < finest:
            raise RequestError(f"{name} = {worst:g}: must be at least {name.split('_', 1)[1]}'s {finest:g}")
    if request.format == _RANGE_MAP:  # no cells: resolution counts in shares of the pixels
        return Fidelity(1.0, error_m), Fidelity(worst_resolution_m / resolution_m, worst_error_m)
    return Fidelity(resolution_m, error_m), Fidelity(worst_resolution_m, worst_error_m)


def _range_m(request: ViewRequest) -> tuple[float, float]:
    near, far = _or(request, "min_range_m", 0.0), _or(request, "max_range_m", math.inf)
    if near >= far:
        raise RequestError(f"max_range_m = {far:g}: must be above min_range_m = {near:g}")
    return near, far


def _absolute_ns(request: ViewRequest) -> tuple[int, int]:
    if request.time_mode != ViewRequest.TIME_MODE_ABSOLUTE:
        return 0, 0
    for name in ("start_ns", "end_ns"):
        if not request.HasField(name):
            raise RequestError(f"{name}: must be said with TIME_MODE_ABSOLUTE")
    if request.start_ns > request.end_ns:
        raise RequestError(f"end_ns = {request.end_ns}: must not be before start_ns = {request.start_ns}")
    return request.start_ns, request.end_ns


def _frame_from_view(request: ViewRequest) -> FloatArray:
    """(4, 4): yaw about z, pitch about the new y, roll about the new x."""
    (sr, sp, sy), (cr, cp, cy) = (
        tuple(turn(angle) for angle in (request.roll_rad, request.pitch_rad, request.yaw_rad))
        for turn in (math.sin, math.cos)
    )
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, request.x_m],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, request.y_m],
            [-sp, cp * sr, cp * cr, request.z_m],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _half_planes(request: ViewRequest) -> FloatArray:
    rows = [[p.normal_x, p.normal_y, p.normal_z, p.offset_m] for p in request.half_planes]
    for index, row in enumerate(rows):
        if math.hypot(*row[:3]) < 0.5:
            raise RequestError(f"half_planes[{index}]: its normal must be a unit vector")
    return np.array(rows).reshape(-1, 4)


def _check_size(wish: ViewWish) -> None:
    if wish.form == _HEIGHT_MAP:
        grid = wish.grid(wish.finest.resolution)
        if grid.columns * grid.rows > MAX_CELLS:
            raise RequestError(
                f"resolution_m = {wish.finest.resolution:g}: {grid.columns} x {grid.rows} cells in the box "
                f"are more than {MAX_CELLS}"
            )
    elif wish.form == _RANGE_MAP and wish.projection.columns * wish.projection.rows > MAX_CELLS:
        columns, rows = wish.projection.columns, wish.projection.rows
        raise RequestError(f"width_px = {columns}: {columns} x {rows} pixels are more than {MAX_CELLS}")

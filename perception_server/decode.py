"""The operator's side of views: bytes to arrays, points in the world, and messages that any viewer shows."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from foxglove_schemas_protobuf.Grid_pb2 import Grid as GridMessage
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from google.protobuf.message import DecodeError as ProtobufError
from google.protobuf.timestamp_pb2 import Timestamp
from numpy.typing import NDArray

from messages.proto.straitlink.view_pb2 import VIEW_STATUS_RENDERED, View, ViewRequest
from perception_server.compact_pose import pose_matrix, quaternion
from perception_server.frames import FloatArray
from perception_server.height_map import Grid
from perception_server.range_map import Projection
from perception_server.view_codec import DecodeError, decode_cloud, decode_map, decode_octree
from perception_server.view_codec.map_codec import MapView

MAX_VIEW_BYTES = 4 << 20

_MAPS = (ViewRequest.FORMAT_HEIGHT_MAP, ViewRequest.FORMAT_RANGE_MAP)


@dataclass(frozen=True, slots=True, eq=False)
class DecodedView:
    """A view of geometry as arrays. Everything is in metres.

    header: the message without its data. world_from_view: (4, 4).
    values: (rows, columns) float32, NaN in holes: heights along the view's z (row 0 at the lowest y), or
    ranges (row 0 on top); None for clouds and octrees.
    points_m: (N, 3) float32 in the view's frame: cells' centres, pixels' surfaces, points, leaves' centres.
    max_error_m: of coding, stated by the sender. closed: cells that were filled from their neighbours.
    """

    header: View
    world_from_view: FloatArray
    values: NDArray[np.float32] | None
    closed: NDArray[np.bool_] | None
    points_m: NDArray[np.float32]
    max_error_m: float

    @property
    def world_points_m(self) -> FloatArray:
        """(N, 3) float64 in the frame header.world_frame_id."""
        points: FloatArray = self.points_m @ self.world_from_view[:3, :3].T + self.world_from_view[:3, 3]
        return points


def decode_view(data: bytes) -> DecodedView:
    """A View message that carries a picture. Raises DecodeError for anything else."""
    return decode_view_message(parse_view(data))


def parse_view(data: bytes) -> View:
    """The message alone, whatever its status. Raises DecodeError."""
    if len(data) > MAX_VIEW_BYTES:
        raise DecodeError(f"a view of {len(data)} bytes is above {MAX_VIEW_BYTES}")
    view = View()
    try:
        view.ParseFromString(data)
    except ProtobufError as error:
        raise DecodeError(f"{len(data)} bytes are no straitlink.View") from error
    return view


def decode_view_message(view: View) -> DecodedView:
    """A parsed View that carries a picture. Raises DecodeError."""
    if view.status != VIEW_STATUS_RENDERED:
        raise DecodeError(f"a view with status {view.status} carries no picture: {view.error[:200]}")
    for name in ("min_x_m", "min_y_m", "resolution_m", "horizontal_fov_rad", "vertical_fov_rad"):
        if not math.isfinite(getattr(view, name)):
            raise DecodeError(f"{name} of a view is not finite")
    try:
        world_from_view = pose_matrix(view.world_from_view)
    except ValueError as error:
        raise DecodeError(str(error)) from error
    header = View()
    header.CopyFrom(view)
    header.ClearField("data")
    if view.format in _MAPS:
        coded = decode_map(view.data)
        points = _map_points(view, coded)
        return DecodedView(header, world_from_view, coded.values, coded.closed, points, coded.max_error_m)
    if view.format == ViewRequest.FORMAT_CLOUD:
        cloud = decode_cloud(view.data)
        return DecodedView(header, world_from_view, None, None, cloud.points, cloud.max_error_m)
    if view.format == ViewRequest.FORMAT_OCTREE:
        octree = decode_octree(view.data)
        to_corner_m = octree.leaf_m * 3**0.5 / 2
        return DecodedView(header, world_from_view, None, None, octree.centres, to_corner_m)
    raise DecodeError(f"a view of format {view.format} is none that can be decoded")


def _map_points(view: View, coded: MapView) -> NDArray[np.float32]:
    """(N, 3) of the cells that are no holes, in the view's frame."""
    rows, columns = coded.values.shape
    known = np.isfinite(coded.values)
    if view.format == ViewRequest.FORMAT_HEIGHT_MAP:
        if not 0 < view.resolution_m <= 100:
            raise DecodeError(f"resolution_m = {view.resolution_m:g} of a height map is outside 0..100")
        row, column = np.nonzero(known)
        x = view.min_x_m + (column + 0.5) * view.resolution_m
        y = view.min_y_m + (row + 0.5) * view.resolution_m
        return np.stack([x, y, coded.values[known]], axis=-1).astype(np.float32)
    spherical = view.projection == ViewRequest.PROJECTION_SPHERICAL
    widest = 6.3 if spherical else 3.01
    if not (0 < view.horizontal_fov_rad <= widest and 0 < view.vertical_fov_rad <= 3.2):
        raise DecodeError(
            f"fields of view of {view.horizontal_fov_rad:g} and {view.vertical_fov_rad:g} rad cannot be"
        )
    projection = Projection(spherical, columns, rows, view.horizontal_fov_rad, view.vertical_fov_rad)
    rays = projection.rays()[known]
    return (rays * coded.values[known][:, None]).astype(np.float32)


def to_point_cloud(view: DecodedView) -> PointCloud:
    """foxglove.PointCloud of any view: x, y, z as float32 in the view's frame, its pose in the world."""
    message = PointCloud(frame_id=view.header.world_frame_id, point_stride=12)
    _stamp(message.timestamp, view.header.newest_ns)
    _set_pose(message, view.world_from_view)
    for index, name in enumerate("xyz"):
        message.fields.add(name=name, offset=4 * index, type=PackedElementField.FLOAT32)
    message.data = np.ascontiguousarray(view.points_m, dtype="<f4").tobytes()
    return message


def to_grid(view: DecodedView) -> GridMessage:
    """foxglove.Grid of a height map: one field "elevation", float32 metres, NaN in holes.

    Raises ValueError for a view of another format.
    """
    if view.header.format != ViewRequest.FORMAT_HEIGHT_MAP or view.values is None:
        name = ViewRequest.Format.Name(view.header.format)
        raise ValueError(f"format = {name}: only a height map is a grid")
    cell_m = view.header.resolution_m
    corner = np.eye(4)
    corner[:2, 3] = view.header.min_x_m, view.header.min_y_m
    message = GridMessage(
        frame_id=view.header.world_frame_id,
        column_count=view.values.shape[1],
        row_stride=4 * view.values.shape[1],
        cell_stride=4,
        data=np.ascontiguousarray(view.values, dtype="<f4").tobytes(),
    )
    message.fields.add(name="elevation", offset=0, type=PackedElementField.FLOAT32)
    message.cell_size.x = message.cell_size.y = cell_m
    _stamp(message.timestamp, view.header.newest_ns)
    _set_pose(message, view.world_from_view @ corner)
    return message


def grid_of(view: DecodedView) -> Grid:
    """Where the cells of a decoded height map lie, in the view's frame."""
    if view.values is None:
        raise ValueError("a cloud or an octree has no cells")
    rows, columns = view.values.shape
    return Grid(view.header.min_x_m, view.header.min_y_m, view.header.resolution_m, columns, rows)


def _set_pose(message: PointCloud | GridMessage, matrix: FloatArray) -> None:
    position, orientation = message.pose.position, message.pose.orientation
    position.x, position.y, position.z = matrix[:3, 3].tolist()
    orientation.x, orientation.y, orientation.z, orientation.w = quaternion(matrix[:3, :3])


def _stamp(timestamp: Timestamp, capture_ns: int) -> None:
    timestamp.seconds, timestamp.nanos = divmod(capture_ns, 1_000_000_000)

"""Scanners', clouds', stereo and frames' messages as they are on a bus: Foxglove protobufs and ROS 2 CDR."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, TypeAlias

import numpy as np
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from google.protobuf.message import DecodeError as ProtobufDecodeError
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from perception_server.errors import InputError
from perception_server.frames import StampedTransform, rotate
from perception_server.pictures import Disparity
from perception_server.scan_geometry import RawCloud, RawScan

Geometry: TypeAlias = RawScan | RawCloud | Disparity | list[StampedTransform]
Pose: TypeAlias = tuple[float, float, float, float, float, float, float]

MAX_BEAMS = 100_000
MAX_POINTS = 4_000_000
MAX_TRANSFORMS = 1_000  # in one message
_NS_PER_S = 1_000_000_000
_PROTOBUF, _CDR = "application/protobuf;", "application/cdr;"
_COORDINATES: dict[int, str] = {7: "f4", 8: "f8"}  # FLOAT32 and FLOAT64, of ROS and of Foxglove alike
_PERIODS_KEPT = 16


class ScanTiming:
    """When each beam of a scan was taken, for scans that do not say.

    mirror_period_s: by source, the time of a whole turn of the mirror. For sources without, it is taken
    from the stamps: the shortest of the last distances between scans, since a scan may be lost.
    """

    def __init__(self, mirror_period_s: Mapping[str, float] | None = None) -> None:
        self._said = dict(mirror_period_s or {})
        self._last_ns: dict[str, int] = {}
        self._distances_ns: dict[str, list[int]] = {}

    def beam_period_ns(self, source: str, start_ns: int, step_rad: float) -> float:
        """Between two beams a step apart; 0 for the first scan of a source that says nothing."""
        if source in self._said:
            return self._said[source] * _NS_PER_S * abs(step_rad) / (2 * math.pi)
        distances = self._distances_ns.setdefault(source, [])
        last_ns = self._last_ns.get(source, start_ns)
        if start_ns > last_ns:
            distances.append(start_ns - last_ns)
            del distances[:-_PERIODS_KEPT]
        self._last_ns[source] = start_ns
        return min(distances, default=0) * abs(step_rad) / (2 * math.pi)


@dataclass(slots=True)
class GeometryInputs:
    """Reads messages; holds what they leave out.

    static_sources: keys whose transforms hold at all times; those that end in "tf_static" do anyway.
    """

    timing: ScanTiming = field(default_factory=ScanTiming)
    static_sources: frozenset[str] = frozenset()

    def decode(self, source: str, encoding: str, payload: bytes) -> Geometry | None:
        """What a message says; None for a type that is none of geometry's.

        encoding: as Zenoh has it, media type and type. Raises InputError for bytes that are not that type,
        or that no device sends.
        """
        read = _READERS.get(encoding)
        if read is None:
            return None
        try:
            return read(self, source, payload)
        except InputError:
            raise
        except Exception as error:  # rosbags raises whatever its generated code runs into
            raise InputError(f"{source}: the bytes are no {encoding.partition(';')[2]}: {error}") from error

    def is_static(self, source: str) -> bool:
        """Whether its transforms hold at all times."""
        return source in self.static_sources or source.endswith("tf_static")


def _foxglove_scan(inputs: GeometryInputs, source: str, payload: bytes) -> RawScan:
    message = _parsed(LaserScan(), payload)
    beams = len(message.ranges)
    step_rad = (message.end_angle - message.start_angle) / max(1, beams - 1)
    start_ns = _stamp_ns(message.timestamp.seconds, message.timestamp.nanos)
    return _checked_scan(
        RawScan(
            source,
            _name(message.frame_id),
            start_ns,
            inputs.timing.beam_period_ns(source, start_ns, step_rad),
            message.start_angle,
            step_rad,
            np.array(message.ranges, dtype=np.float32),
            frame_from_scanner=_foxglove_pose(message.pose),
        )
    )


def _ros_scan(inputs: GeometryInputs, source: str, payload: bytes) -> RawScan:
    message: Any = _ros2_types().deserialize_cdr(payload, "sensor_msgs/msg/LaserScan")
    start_ns = _ros_stamp_ns(message)
    said_ns = message.time_increment * _NS_PER_S
    return _checked_scan(
        RawScan(
            source,
            _name(message.header.frame_id),
            start_ns,
            said_ns or inputs.timing.beam_period_ns(source, start_ns, message.angle_increment),
            message.angle_min,
            message.angle_increment,
            np.asarray(message.ranges, dtype=np.float32),
            message.range_min,
            message.range_max,
        )
    )


def _checked_scan(scan: RawScan) -> RawScan:
    numbers = (scan.angle_min_rad, scan.angle_step_rad, scan.beam_period_ns, scan.min_range_m)
    if not all(map(math.isfinite, numbers)) or scan.beam_period_ns < 0:
        raise InputError(f"{scan.sensor}: angles or times of a scan are not finite")
    if scan.ranges_m.size > MAX_BEAMS:
        raise InputError(f"{scan.sensor}: {scan.ranges_m.size} beams are above {MAX_BEAMS}")
    return scan


def _foxglove_cloud(inputs: GeometryInputs, source: str, payload: bytes) -> RawCloud:
    message = _parsed(PointCloud(), payload)
    fields = {item.name: (item.offset, item.type) for item in message.fields}
    data = np.frombuffer(message.data, np.uint8)
    points = _points(
        source, data, message.point_stride, len(data) // max(1, message.point_stride), fields, "<"
    )
    pose = np.array(_foxglove_pose(message.pose))
    if not np.array_equal(pose, [0, 0, 0, 0, 0, 0, 1]):
        points = (rotate(pose[3:], points.astype(np.float64)) + pose[:3]).astype(np.float32)
    stamp_ns = _stamp_ns(message.timestamp.seconds, message.timestamp.nanos)
    return RawCloud(source, _name(message.frame_id), stamp_ns, points)


def _ros_cloud(inputs: GeometryInputs, source: str, payload: bytes) -> RawCloud:
    message: Any = _ros2_types().deserialize_cdr(payload, "sensor_msgs/msg/PointCloud2")
    fields = {item.name: (item.offset, item.datatype) for item in message.fields}
    data = np.asarray(message.data, dtype=np.uint8)
    if message.row_step != message.width * message.point_step and message.height > 1:
        rows = data[: message.row_step * message.height].reshape(message.height, message.row_step)
        data = np.ascontiguousarray(rows[:, : message.width * message.point_step]).ravel()
    order = ">" if message.is_bigendian else "<"
    points = _points(source, data, message.point_step, message.width * message.height, fields, order)
    return RawCloud(source, _name(message.header.frame_id), _ros_stamp_ns(message), points)


def _points(
    source: str,
    data: NDArray[np.uint8],
    stride: int,
    count: int,
    fields: Mapping[str, tuple[int, int]],
    order: str,
) -> NDArray[np.float32]:
    """(N, 3) float32 of packed points."""
    if not 0 <= count <= MAX_POINTS:
        raise InputError(f"{source}: {count} points are above {MAX_POINTS}")
    if count * stride > data.size or stride < 1:
        raise InputError(f"{source}: {data.size} bytes are fewer than {count} points of {stride}")
    points = np.empty((count, 3), dtype=np.float32)
    rows = data[: count * stride].reshape(count, stride)
    for axis, name in enumerate("xyz"):
        offset, kind = fields.get(name, (0, 0))
        if kind not in _COORDINATES:
            raise InputError(f"{source}: a cloud without {name} as FLOAT32 or FLOAT64")
        number = np.dtype(order + _COORDINATES[kind])
        if offset + number.itemsize > stride:
            raise InputError(f"{source}: {name} at byte {offset} is beyond a point of {stride} bytes")
        column = np.ascontiguousarray(rows[:, offset : offset + number.itemsize])
        points[:, axis] = column.view(number)[:, 0]
    return points


def _foxglove_transforms(inputs: GeometryInputs, source: str, payload: bytes) -> list[StampedTransform]:
    return _all_transforms(inputs, source, _parsed(FrameTransforms(), payload).transforms)


def _foxglove_transform(inputs: GeometryInputs, source: str, payload: bytes) -> list[StampedTransform]:
    return _all_transforms(inputs, source, [_parsed(FrameTransform(), payload)])


def _all_transforms(inputs: GeometryInputs, source: str, items: Any) -> list[StampedTransform]:
    if len(items) > MAX_TRANSFORMS:
        raise InputError(f"{source}: {len(items)} transforms are above {MAX_TRANSFORMS}")
    static = inputs.is_static(source)
    return [
        StampedTransform(
            _stamp_ns(item.timestamp.seconds, item.timestamp.nanos),
            _name(item.parent_frame_id),
            _name(item.child_frame_id),
            _pose(item.translation, item.rotation),
            static,
        )
        for item in items
    ]


def _ros_transforms(inputs: GeometryInputs, source: str, payload: bytes) -> list[StampedTransform]:
    message: Any = _ros2_types().deserialize_cdr(payload, "tf2_msgs/msg/TFMessage")
    if len(message.transforms) > MAX_TRANSFORMS:
        raise InputError(f"{source}: {len(message.transforms)} transforms are above {MAX_TRANSFORMS}")
    static = inputs.is_static(source)
    return [
        StampedTransform(
            _ros_stamp_ns(item),
            _name(item.header.frame_id),
            _name(item.child_frame_id),
            _pose(item.transform.translation, item.transform.rotation),
            static,
        )
        for item in message.transforms
    ]


def _ros_disparity(inputs: GeometryInputs, source: str, payload: bytes) -> Disparity:
    """The optical centre is taken as the image's own: the message does not say it."""
    message: Any = _ros2_types().deserialize_cdr(payload, "stereo_msgs/msg/DisparityImage")
    image = message.image
    if image.encoding != "32FC1" or image.width * image.height > MAX_POINTS:
        raise InputError(f"{source}: a disparity image is 32FC1, at most {MAX_POINTS} pixels")
    if not (message.f > 0 and abs(message.t) > 0):
        raise InputError(f"{source}: focal length {message.f} and baseline {message.t} must not be 0")
    order = ">" if image.is_bigendian else "<"
    rows = np.asarray(image.data, dtype=np.uint8)[: image.step * image.height].reshape(
        image.height, image.step
    )
    pixels = np.ascontiguousarray(rows[:, : 4 * image.width]).view(f"{order}f4").astype(np.float32)
    return Disparity(
        source,
        _name(message.header.frame_id),
        _ros_stamp_ns(message),
        np.where(pixels >= message.min_disparity, pixels, np.float32(np.nan)),
        message.f,
        abs(message.t),
        (image.width - 1) / 2,
        (image.height - 1) / 2,
    )


def _parsed(message: Any, payload: bytes) -> Any:
    try:
        message.ParseFromString(payload)
    except ProtobufDecodeError as error:
        raise InputError(f"the bytes are no {message.DESCRIPTOR.full_name}: {error}") from error
    return message


def _name(frame_id: str) -> str:
    return frame_id.removeprefix("/")  # as tf1 had them; REP-105 has none


def _stamp_ns(seconds: int, nanos: int) -> int:
    return int(seconds * _NS_PER_S + nanos)


def _ros_stamp_ns(message: Any) -> int:
    return _stamp_ns(message.header.stamp.sec, message.header.stamp.nanosec)


def _pose(translation: Any, rotation: Any) -> Pose:
    return translation.x, translation.y, translation.z, rotation.x, rotation.y, rotation.z, rotation.w


def _foxglove_pose(pose: Any) -> Pose:
    row = _pose(pose.position, pose.orientation)
    return row if any(row[3:]) else (*row[:3], 0.0, 0.0, 0.0, 1.0)  # left out: upright


@cache
def _ros2_types() -> Typestore:
    return get_typestore(Stores.LATEST)


_READERS: dict[str, Callable[[GeometryInputs, str, bytes], Geometry]] = {
    f"{_PROTOBUF}foxglove.LaserScan": _foxglove_scan,
    f"{_PROTOBUF}foxglove.PointCloud": _foxglove_cloud,
    f"{_PROTOBUF}foxglove.FrameTransforms": _foxglove_transforms,
    f"{_PROTOBUF}foxglove.FrameTransform": _foxglove_transform,
    f"{_CDR}sensor_msgs/msg/LaserScan": _ros_scan,
    f"{_CDR}sensor_msgs/msg/PointCloud2": _ros_cloud,
    f"{_CDR}tf2_msgs/msg/TFMessage": _ros_transforms,
    f"{_CDR}stereo_msgs/msg/DisparityImage": _ros_disparity,
}

"""Scans, clouds, transforms and disparity as devices publish them, in both encodings."""

from __future__ import annotations

import math

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from messages.proto.straitlink.view_pb2 import VIEW_STATUS_RENDERED, View, ViewRequest
from perception_server.decode import decode_view_message
from perception_server.errors import InputError
from perception_server.geometry_inputs import _READERS, GeometryInputs, ScanTiming
from perception_server.pictures import Disparity
from perception_server.scan_geometry import RawCloud, RawScan, ScanPlacement
from perception_server.sensors import SensorHistory

S = 1_000_000_000
FOXGLOVE = "application/protobuf;foxglove."
ROS = "application/cdr;"
STORE = get_typestore(Stores.LATEST)


def ros(name: str, **fields: object) -> bytes:
    return bytes(STORE.serialize_cdr(STORE.types[name](**fields), name))


def header(frame_id: str, sec: int = 5, nanosec: int = 7) -> object:
    stamp = STORE.types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)
    return STORE.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id)


def foxglove_scan(at_ns: int, ranges: list[float]) -> bytes:
    message = LaserScan(frame_id="lidar", start_angle=-1.0, end_angle=1.0, ranges=ranges)
    message.timestamp.FromNanoseconds(at_ns)
    return message.SerializeToString()


def test_a_foxglove_scan_is_timed_by_its_mirror() -> None:
    inputs = GeometryInputs(ScanTiming({"lidar": 0.025}))
    scan = inputs.decode("lidar", f"{FOXGLOVE}LaserScan", foxglove_scan(5 * S, [1.0, math.inf, 3.0]))
    assert isinstance(scan, RawScan)
    assert (scan.start_ns, scan.angle_min_rad, scan.angle_step_rad) == (5 * S, -1.0, 1.0)
    assert scan.beam_period_ns == pytest.approx(0.025 * S / (2 * math.pi))
    assert scan.ranges_m.tolist() == [1.0, math.inf, 3.0]
    assert scan.frame_from_scanner == (0, 0, 0, 0, 0, 0, 1)


def test_an_unsaid_mirror_period_is_the_least_distance_between_scans() -> None:
    inputs = GeometryInputs()
    for at_s in (5.0, 5.2, 5.3, 5.5):
        scan = inputs.decode("lidar", f"{FOXGLOVE}LaserScan", foxglove_scan(round(at_s * S), [1.0] * 3))
    assert isinstance(scan, RawScan)
    assert scan.beam_period_ns == pytest.approx(0.1 * S / (2 * math.pi))


def test_a_ros_scan_says_all_that_it_needs() -> None:
    payload = ros(
        "sensor_msgs/msg/LaserScan",
        header=header("/laser"),
        angle_min=-0.5,
        angle_max=0.5,
        angle_increment=0.5,
        time_increment=0.001,
        scan_time=0.1,
        range_min=0.25,
        range_max=8.0,
        ranges=np.array([1, 2, 3], np.float32),
        intensities=np.zeros(0, np.float32),
    )
    scan = GeometryInputs().decode("scan", f"{ROS}sensor_msgs/msg/LaserScan", payload)
    assert isinstance(scan, RawScan)
    assert (scan.frame_id, scan.start_ns, scan.min_range_m, scan.max_range_m) == (
        "laser",
        5 * S + 7,
        0.25,
        8.0,
    )
    assert scan.beam_period_ns == pytest.approx(1_000_000)
    assert scan.end_ns == pytest.approx(scan.start_ns + 2_000_000, abs=2)


def ros_cloud(points: np.ndarray, stride: int, big_endian: bool = False, kind: int = 7) -> bytes:
    field = STORE.types["sensor_msgs/msg/PointField"]
    size = 4 if kind == 7 else 8
    data = np.zeros((len(points), stride), np.uint8)
    for axis in range(3):
        number = np.dtype((">" if big_endian else "<") + ("f4" if kind == 7 else "f8"))
        column = points[:, axis].astype(number).view(np.uint8).reshape(-1, size)
        data[:, 2 + size * axis : 2 + size * axis + size] = column
    return ros(
        "sensor_msgs/msg/PointCloud2",
        header=header("depth"),
        height=1,
        width=len(points),
        fields=[field(name=n, offset=2 + size * i, datatype=kind, count=1) for i, n in enumerate("xyz")],
        is_bigendian=big_endian,
        point_step=stride,
        row_step=stride * len(points),
        data=data.ravel(),
        is_dense=True,
    )


@pytest.mark.parametrize(("stride", "big_endian", "kind"), [(14, False, 7), (32, True, 7), (27, False, 8)])
def test_a_ros_cloud_is_read_by_its_fields(stride: int, big_endian: bool, kind: int) -> None:
    points = np.random.default_rng(1).normal(size=(50, 3)).astype(np.float32)
    payload = ros_cloud(points, stride, big_endian, kind)
    cloud = GeometryInputs().decode("depth", f"{ROS}sensor_msgs/msg/PointCloud2", payload)
    assert isinstance(cloud, RawCloud)
    np.testing.assert_array_equal(cloud.points_m, points)


def test_a_foxglove_cloud_stands_at_its_pose() -> None:
    message = PointCloud(frame_id="depth", point_stride=12, data=np.array([1, 2, 3], "<f4").tobytes())
    for index, name in enumerate("xyz"):
        message.fields.add(name=name, offset=4 * index, type=7)
    message.pose.position.z = 10.0
    message.pose.orientation.z = message.pose.orientation.w = math.sqrt(0.5)
    cloud = GeometryInputs().decode("depth", f"{FOXGLOVE}PointCloud", message.SerializeToString())
    assert isinstance(cloud, RawCloud)
    np.testing.assert_allclose(cloud.points_m, [[-2, 1, 13]], atol=1e-6)


def test_transforms_of_a_static_topic_hold_at_all_times() -> None:
    message = FrameTransforms()
    item = message.transforms.add(parent_frame_id="/map", child_frame_id="base")
    item.timestamp.FromNanoseconds(3 * S)
    item.translation.x, item.rotation.w = 1.5, 1.0
    for source, static in (("robot/tf", False), ("robot/tf_static", True)):
        read = GeometryInputs().decode(source, f"{FOXGLOVE}FrameTransforms", message.SerializeToString())
        assert isinstance(read, list)
        assert (read[0].parent, read[0].stamp_ns, read[0].is_static) == ("map", 3 * S, static)
        assert read[0].pose == (1.5, 0, 0, 0, 0, 0, 1)


def test_a_ros_disparity_image_drops_what_is_below_its_least() -> None:
    pixels = np.array([[5.0, -1.0], [0.5, 7.0]], np.float32)
    region = STORE.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    image = STORE.types["sensor_msgs/msg/Image"](
        header("left"), 2, 2, "32FC1", 0, 8, pixels.view(np.uint8).ravel()
    )
    payload = ros(
        "stereo_msgs/msg/DisparityImage",
        header=header("left"),
        image=image,
        f=100.0,
        t=0.1,
        valid_window=region,
        min_disparity=1.0,
        max_disparity=64.0,
        delta_d=0.1,
    )
    disparity = GeometryInputs().decode("stereo", f"{ROS}stereo_msgs/msg/DisparityImage", payload)
    assert isinstance(disparity, Disparity)
    np.testing.assert_array_equal(disparity.disparity_px, [[5.0, np.nan], [np.nan, 7.0]])
    assert (disparity.focal_px, disparity.centre_x_px) == (100.0, 0.5)


def test_another_s_message_is_none_of_geometry() -> None:
    assert GeometryInputs().decode("x", f"{FOXGLOVE}CompressedImage", b"") is None


@given(st.sampled_from(sorted(_READERS)), st.binary(max_size=200))
def test_bytes_that_are_no_message_are_an_input_error_and_nothing_else(encoding: str, payload: bytes) -> None:
    try:
        GeometryInputs().decode("sensor", encoding, payload)
    except InputError as error:
        assert str(error)


def test_the_server_s_seam_answers_what_the_scanner_saw() -> None:
    known = SensorHistory({"robot/tf": "tf", "robot/lidar/scan": "lidar"}, placement=ScanPlacement("map"))
    message = FrameTransforms()
    for at_ns in (4 * S, 6 * S):
        item = message.transforms.add(parent_frame_id="map", child_frame_id="lidar")
        item.timestamp.FromNanoseconds(at_ns)
        item.rotation.w = 1.0
    known.take("robot/tf", f"{FOXGLOVE}FrameTransforms", message.SerializeToString(), 104 * S, 0)
    known.take("robot/lidar/scan", f"{FOXGLOVE}LaserScan", foxglove_scan(5 * S, [2.0] * 9), 105 * S, 0)
    known.take("robot/lidar/scan", f"{FOXGLOVE}LaserScan", b"\xff", 105 * S, 0)
    request = ViewRequest(preset="cloud_scene", frame_id="lidar")
    assert known.newest_ns(request) == 5 * S
    view, source_ns, bus_ns = known.answer(request, 10_000)
    assert isinstance(view, View)
    assert (view.status, source_ns) == (VIEW_STATUS_RENDERED, 5 * S)
    assert bus_ns == 5 * S + (104 - 6) * S  # the newest stamp is the transforms'
    points = decode_view_message(view).world_points_m
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 2.0, atol=0.006)
    assert known.counters["refused robot/lidar/scan"] == 1

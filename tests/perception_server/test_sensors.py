"""Cameras' messages in, pictures out."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from rosbags.typesys import Stores, get_typestore

from messages.proto.straitlink.view_pb2 import VIEW_STATUS_NO_DATA, VIEW_STATUS_RENDERED, Image, ImageRequest
from perception_server.picture_file import decode_picture
from perception_server.sensors import SensorHistory
from tests.perception_server.camera_frames import S, head_picture, jpeg

KEY = "robot/head_camera/image"
BUS_NS = 1_700_000_000 * S
FOXGLOVE = "application/protobuf;foxglove.CompressedImage"


def compressed(step: int, at_ns: int) -> bytes:
    message = CompressedImage(frame_id="head_optical", format="jpeg", data=jpeg(step))
    message.timestamp.FromNanoseconds(at_ns)
    return message.SerializeToString()


def sensors() -> SensorHistory:
    return SensorHistory({KEY: "head"})


def answer(known: SensorHistory, **said: object) -> tuple[Image, int, int]:
    reply, source_ns, bus_ns = known.answer(ImageRequest(**said), 100_000)  # type: ignore[arg-type]
    assert isinstance(reply, Image)
    return reply, source_ns, bus_ns


def test_a_frame_is_known_by_the_camera_s_name_its_own_time_and_the_bus_s() -> None:
    known = sensors()
    assert known.newest_ns(ImageRequest(preset="head_low")) is None
    known.take(KEY, FOXGLOVE, compressed(0, 100 * S), BUS_NS, 0)
    known.take(KEY, FOXGLOVE, compressed(1, 101 * S), BUS_NS + S, 0)
    assert known.newest_ns(ImageRequest(preset="head_low")) == 101 * S
    reply, source_ns, bus_ns = answer(known, preset="head_low", at_ns=100 * S)
    assert (reply.source, reply.frame_ns, source_ns, bus_ns) == ("head", 100 * S, 100 * S, BUS_NS)


def test_a_log_that_begins_anew_is_followed() -> None:
    known = sensors()
    known.take(KEY, FOXGLOVE, compressed(0, 160 * S), BUS_NS, 0)
    known.take(KEY, FOXGLOVE, compressed(1, 100 * S), BUS_NS + S, 0)
    reply, source_ns, bus_ns = answer(known, preset="head_low")
    assert (reply.frame_ns, source_ns, bus_ns) == (100 * S, 100 * S, BUS_NS + S)
    assert known.counters["begun anew"] == 1


def test_a_frame_that_overtook_another_leaves_the_newest_the_newest() -> None:
    known = sensors()
    known.take(KEY, FOXGLOVE, compressed(0, 100 * S), BUS_NS, 0)
    known.take(KEY, FOXGLOVE, compressed(1, 99 * S), BUS_NS, 0)
    assert answer(known)[1] == 100 * S and not known.counters


@pytest.mark.parametrize("form", ["foxglove raw", "ros compressed", "ros raw"])
def test_every_kind_of_picture_shows(form: str) -> None:
    small = cv2.resize(head_picture(), (64, 34), interpolation=cv2.INTER_AREA)
    store = get_typestore(Stores.LATEST)
    header = store.types["std_msgs/msg/Header"](store.types["builtin_interfaces/msg/Time"](100, 5), "optical")
    if form == "foxglove raw":
        raw = RawImage(frame_id="o", width=64, height=34, step=192, encoding="bgr8", data=small.tobytes())
        raw.timestamp.FromNanoseconds(100 * S + 5)
        encoding, payload = "application/protobuf;foxglove.RawImage", raw.SerializeToString()
    elif form == "ros compressed":
        data = cv2.imencode(".png", small)[1]
        name = "sensor_msgs/msg/CompressedImage"
        message = store.types[name](header, "png", data)
        encoding, payload = f"application/cdr;{name}", bytes(store.serialize_cdr(message, name))
    else:
        name = "sensor_msgs/msg/Image"
        message = store.types[name](header, 34, 64, "rgb8", 0, 192, small[..., ::-1].ravel())
        encoding, payload = f"application/cdr;{name}", bytes(store.serialize_cdr(message, name))
    known = sensors()
    known.take(KEY, encoding, payload, BUS_NS, 0)
    reply, source_ns, _ = answer(known, downsample=1, quality=98)
    assert reply.status == VIEW_STATUS_RENDERED and source_ns == 100 * S + 5
    assert np.abs(decode_picture(reply.data).astype(int) - small).mean() < 3


def test_a_calibration_belongs_to_the_frames_of_its_optical_frame() -> None:
    known = sensors()
    known.take(KEY, FOXGLOVE, compressed(0, 100 * S), BUS_NS, 0)
    matrix = [610.0, 0, 511.5, 0, 610, 271.5, 0, 0, 1]
    message = CameraCalibration(
        frame_id="head_optical", width=1024, height=544, distortion_model="", K=matrix
    )
    known.take(
        "robot/c", "application/protobuf;foxglove.CameraCalibration", message.SerializeToString(), 0, 0
    )
    reply, *_ = answer(known, horizontal_fov_rad=0.5, width_px=80)
    assert reply.status == VIEW_STATUS_RENDERED and reply.width_px == 80


def test_a_publisher_that_does_not_say_its_type_has_it_from_the_configuration() -> None:
    known = SensorHistory({KEY: "head"}, encodings={KEY: FOXGLOVE})
    known.take(KEY, "zenoh/bytes", compressed(0, 100 * S), BUS_NS, 0)
    assert answer(known)[1] == 100 * S


@pytest.mark.parametrize(
    ("encoding", "payload"),
    [
        (FOXGLOVE, b"\xff\xff"),
        ("application/cdr;sensor_msgs/msg/CompressedImage", b"\x00\x01"),
        ("application/cdr;sensor_msgs/msg/Imu", b""),
        ("image/jpeg", b"x"),
    ],
)
def test_what_cannot_be_read_is_counted(encoding: str, payload: bytes) -> None:
    known = sensors()
    known.take(KEY, encoding, payload, BUS_NS, 0)
    assert known.counters[f"refused {KEY}"] == 1
    assert answer(known)[0].status == VIEW_STATUS_NO_DATA

"""Cameras' messages as they are on a bus: Foxglove protobufs and ROS 2 CDR, into the history's values."""

from __future__ import annotations

from functools import cache
from typing import Any

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError as ProtobufDecodeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from perception_server.errors import InputError
from perception_server.pictures import Calibration, CameraFrame

_NS_PER_S = 1_000_000_000
_PROTOBUF, _CDR = "application/protobuf;", "application/cdr;"
_FOXGLOVE: dict[str, Any] = {
    "foxglove.CompressedImage": CompressedImage,
    "foxglove.RawImage": RawImage,
    "foxglove.CameraCalibration": CameraCalibration,
}
_ROS = {
    "sensor_msgs/msg/CompressedImage": "CompressedImage",
    "sensor_msgs/msg/Image": "RawImage",
    "sensor_msgs/msg/CameraInfo": "CameraCalibration",
}


def decode_camera_message(source: str, encoding: str, payload: bytes) -> CameraFrame | Calibration:
    """A frame or a calibration. encoding: as Zenoh has it, media type and type. Raises InputError."""
    if encoding.startswith(_PROTOBUF) and (kind := _FOXGLOVE.get(encoding.removeprefix(_PROTOBUF))):
        message = kind()
        try:
            message.ParseFromString(payload)
        except ProtobufDecodeError as error:
            raise InputError(f"{source}: the bytes are no {kind.DESCRIPTOR.full_name}: {error}") from error
        stamp = message.timestamp
        return _item(source, kind.DESCRIPTOR.name, message, message.frame_id, stamp.seconds, stamp.nanos)
    name = encoding.removeprefix(_CDR)
    if encoding.startswith(_CDR) and name in _ROS:
        try:
            message = _deserialised(payload, name)
        except Exception as error:  # rosbags raises what its generated code runs into
            raise InputError(f"{source}: the bytes are no {name}: {error}") from error
        header = message.header
        return _item(source, _ROS[name], message, header.frame_id, header.stamp.sec, header.stamp.nanosec)
    known = ", ".join((*_FOXGLOVE, *_ROS))
    raise InputError(f"{source}: {encoding!r} is no camera's message: expected one of {known}")


def _item(
    source: str, kind: str, message: Any, frame_id: str, seconds: int, nanos: int
) -> CameraFrame | Calibration:
    stamp_ns = seconds * _NS_PER_S + nanos
    if kind == "CompressedImage":
        return CameraFrame(source, frame_id, stamp_ns, "jpeg", bytes(message.data))
    if kind == "RawImage":
        encoding = message.encoding.replace("8UC3", "bgr8").replace("8UC1", "mono8")
        size = message.width, message.height, message.step
        return CameraFrame(source, frame_id, stamp_ns, encoding, bytes(message.data), *size)
    model, d, k, r, p = (
        message.distortion_model,
        *(getattr(message, n if hasattr(message, n) else n.lower()) for n in "DKRP"),
    )
    rows = (tuple(float(value) for value in values) for values in (d, k, r, p))
    return Calibration(frame_id, message.width, message.height, model, *rows)


def _deserialised(payload: bytes, name: str) -> Any:
    return _ros2_types().deserialize_cdr(payload, name)


@cache
def _ros2_types() -> Typestore:
    return get_typestore(Stores.LATEST)

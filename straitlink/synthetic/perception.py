"""What the robot sees: scans and camera frames, with the cameras' calibrations."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import cv2
import numpy as np
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.LaserScan_pb2 import LaserScan

from messages.catalogue import CatalogueTopic
from shaper.varint import append_varint
from straitlink.synthetic.camera import Pinhole, Renderer
from straitlink.synthetic.fisheye import FisheyeRenderer
from straitlink.synthetic.frames import (
    HEAD_FROM_HEAD_CAMERA,
    TORSO_FROM_CHEST_CAMERA,
    map_from_head,
    map_from_torso,
)
from straitlink.synthetic.lidar import BEAMS, LIGHT_BEAMS, Scanner
from straitlink.synthetic.rigid import FloatArray
from straitlink.synthetic.robot_state import Samples
from straitlink.synthetic.scene import Box
from straitlink.synthetic.settings import SyntheticSettings
from straitlink.synthetic.textures import Image
from straitlink.synthetic.ticks import blocks, stamp

JPEG_QUALITY = 85
HEAD_FRAME = "head_camera_optical_frame"
CHEST_FRAME = "chest_camera_optical_frame"
_HEAD_FIELD_OF_VIEW_RAD = np.deg2rad(80.0)  # MultiSense SL, 1024x544
_CHEST_FIELD_OF_VIEW_RAD = np.deg2rad(110.0)
_LIGHT_CAMERA_RATE_HZ = 2.5  # drawing is what a light log spends its time on


def head_camera(settings: SyntheticSettings) -> Pinhole:
    """The head camera: 1024x544, light 320x170, 80 degrees wide."""
    width, height = (320, 170) if settings.light else (1024, 544)
    return Pinhole(width, height, width / 2 / float(np.tan(_HEAD_FIELD_OF_VIEW_RAD / 2)))


def chest_camera_size(settings: SyntheticSettings) -> tuple[int, int]:
    """Width and height of the chest fisheye in pixels."""
    return (160, 120) if settings.light else (640, 480)


def scans(topic: CatalogueTopic, settings: SyntheticSettings, boxes: Sequence[Box]) -> Samples:
    """The scanner's turns; a scan's stamp is the instant of its first beam."""
    scanner = Scanner(boxes, settings.seed, LIGHT_BEAMS if settings.light else BEAMS)
    message = LaserScan(frame_id="lidar")
    message.pose.orientation.w = 1.0
    message.start_angle, message.end_angle = scanner.angles_rad[0], scanner.angles_rad[-1]
    for block in blocks(topic, settings):
        for capture_ns, start_s in zip(block.capture_ns.tolist(), block.times_s.tolist(), strict=True):
            scan = scanner.scan(start_s)
            stamp(message.timestamp, capture_ns)
            yield (
                capture_ns,
                b"".join(
                    (
                        message.SerializeToString(),
                        _packed(LaserScan.RANGES_FIELD_NUMBER, scan.ranges_m),
                        _packed(LaserScan.INTENSITIES_FIELD_NUMBER, scan.intensities),
                    )
                ),
            )


def head_images(topic: CatalogueTopic, settings: SyntheticSettings, boxes: Sequence[Box]) -> Samples:
    """The head camera's frames as JPEG."""
    renderer = Renderer(boxes, head_camera(settings), settings.texture, settings.seed)

    def poses(times_s: FloatArray) -> FloatArray:
        return np.asarray(map_from_head(times_s, settings.seed) @ HEAD_FROM_HEAD_CAMERA)

    return _images(topic, settings, HEAD_FRAME, poses, renderer.expose)


def chest_images(topic: CatalogueTopic, settings: SyntheticSettings, boxes: Sequence[Box]) -> Samples:
    """The chest fisheye's frames as JPEG."""
    size, angle = chest_camera_size(settings), float(_CHEST_FIELD_OF_VIEW_RAD)
    renderer = FisheyeRenderer(boxes, size, angle, settings.texture, settings.seed)

    def poses(times_s: FloatArray) -> FloatArray:
        return np.asarray(map_from_torso(times_s, settings.seed) @ TORSO_FROM_CHEST_CAMERA)

    return _images(topic, settings, CHEST_FRAME, poses, renderer.expose)


def head_calibration(topic: CatalogueTopic, settings: SyntheticSettings, boxes: Sequence[Box]) -> Samples:
    """The head camera's intrinsics: a rectified image, no distortion."""
    camera = head_camera(settings)
    message = CameraCalibration(
        frame_id=HEAD_FRAME,
        width=camera.width,
        height=camera.height,
        distortion_model="plumb_bob",
        D=[0.0] * 5,
        K=camera.matrix.ravel(),
        R=np.eye(3).ravel(),
        P=np.column_stack([camera.matrix, np.zeros(3)]).ravel(),
    )
    return _calibrations(topic, settings, message)


def chest_calibration(topic: CatalogueTopic, settings: SyntheticSettings, boxes: Sequence[Box]) -> Samples:
    """The chest fisheye's intrinsics: equidistant, that is Kannala-Brandt with all four k zero."""
    width, height = chest_camera_size(settings)
    matrix = Pinhole(width, height, width / float(_CHEST_FIELD_OF_VIEW_RAD)).matrix
    message = CameraCalibration(
        frame_id=CHEST_FRAME,
        width=width,
        height=height,
        distortion_model="kannala_brandt",
        D=[0.0] * 4,
        K=matrix.ravel(),
        R=np.eye(3).ravel(),
        P=np.column_stack([matrix, np.zeros(3)]).ravel(),
    )
    return _calibrations(topic, settings, message)


PERCEPTION_SOURCES: dict[str, Callable[[CatalogueTopic, SyntheticSettings, Sequence[Box]], Samples]] = {
    "robot/lidar/scan": scans,
    "robot/head_camera/image": head_images,
    "robot/head_camera/calibration": head_calibration,
    "robot/chest_camera/image": chest_images,
    "robot/chest_camera/calibration": chest_calibration,
}


def _packed(field_number: int, values: FloatArray) -> bytes:
    """A repeated double as protobuf writes it: the array's own bytes, without a list of Python floats."""
    data = values.astype("<f8", copy=False).tobytes()
    head = bytearray()
    append_varint(head, field_number << 3 | 2)  # wire type 2: length-delimited
    append_varint(head, len(data))
    return bytes(head) + data


def _images(
    topic: CatalogueTopic,
    settings: SyntheticSettings,
    frame_id: str,
    poses: Callable[[FloatArray], FloatArray],
    expose: Callable[[FloatArray], Image],
) -> Samples:
    for block in blocks(topic, settings, _LIGHT_CAMERA_RATE_HZ):
        for capture_ns, pose in zip(block.capture_ns.tolist(), poses(block.times_s), strict=True):
            with _one_thread():
                encoded, data = cv2.imencode(".jpg", expose(pose), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
            if not encoded:
                raise RuntimeError(f"{topic.key}: OpenCV could not encode a JPEG at quality {JPEG_QUALITY}")
            # A new message for each: one that is used again keeps all data that it ever held in its arena.
            message = CompressedImage(frame_id=frame_id, format="jpeg", data=data.tobytes())
            stamp(message.timestamp, capture_ns)
            yield capture_ns, message.SerializeToString()


@contextmanager
def _one_thread() -> Iterator[None]:
    """OpenCV on one thread: hundreds of small warps keep its pool spinning, for a tenth more CPU."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(threads)


def _calibrations(topic: CatalogueTopic, settings: SyntheticSettings, message: CameraCalibration) -> Samples:
    for block in blocks(topic, settings):
        for capture_ns in block.capture_ns.tolist():
            stamp(message.timestamp, capture_ns)
            yield capture_ns, message.SerializeToString()

"""Frames of the synthetic mission's cameras, drawn once."""

from __future__ import annotations

import math
from functools import cache

import cv2
import numpy as np

from perception_server.camera_model import CameraModel, camera_model
from perception_server.fisheye import Picture
from perception_server.pictures import CameraFrame
from straitlink.synthetic.camera import Pinhole, Renderer
from straitlink.synthetic.fisheye import FisheyeRenderer
from straitlink.synthetic.rigid import transform
from straitlink.synthetic.scene import build_scene

S = 1_000_000_000
LOOK = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
CHEST_FOV_RAD = math.radians(110)


@cache
def head_picture(step: int = 0) -> Picture:
    """(544, 1024, 3), from a little further on with each step."""
    renderer = Renderer(build_scene(1), Pinhole(1024, 544, 610.0), "indoor", 1)
    return renderer.expose(transform(LOOK, (0.5 + 0.2 * step, 0.0, 1.5))).copy()


@cache
def jpeg(step: int = 0) -> bytes:
    return cv2.imencode(".jpg", head_picture(step), [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()


def head_frame(step: int = 0) -> CameraFrame:
    return CameraFrame("head", "head_camera_optical_frame", (100 + step) * S, "jpeg", jpeg(step))


@cache
def chest_picture() -> Picture:
    renderer = FisheyeRenderer(build_scene(1), (640, 480), CHEST_FOV_RAD, "indoor", 1)
    return renderer.expose(transform(LOOK, (0.5, 0.0, 1.2)))


def chest_frame() -> CameraFrame:
    data = cv2.imencode(".png", chest_picture())[1].tobytes()
    return CameraFrame("chest", "chest_camera_optical_frame", 100 * S, "png", data)


def chest_camera() -> CameraModel:
    matrix = Pinhole(640, 480, 640 / CHEST_FOV_RAD).matrix
    return camera_model(640, 480, "kannala_brandt", [0.0] * 4, matrix.ravel())

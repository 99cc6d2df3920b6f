"""One of each view of a made-up scene, so that no operator waits for what is compiled at its first use."""

from __future__ import annotations

import cv2
import numpy as np

from messages.proto.straitlink.view_pb2 import VIEW_STATUS_RENDERED, ImageRequest, ViewRequest
from perception_server.answer import answer
from perception_server.decode import decode_view
from perception_server.frames import StampedTransform
from perception_server.history import History
from perception_server.image_answer import answer_image
from perception_server.pictures import CameraFrame
from perception_server.readiness import Readiness
from perception_server.scan_geometry import RawScan
from perception_server.view_codec import unpack_jpeg
from perception_server.view_codec.map_codec import warm_up as warm_up_maps

_BUDGET_BYTES = 100_000
_S = 1_000_000_000


def warm_up(readiness: Readiness | None = None) -> None:
    """Load or compile every kernel: up to a minute or two the first time on a machine, later a second.

    readiness: told what is ready, pictures first. Raises RuntimeError if a kernel gives what it must not,
    as from machine code of an older source.
    """
    readiness = readiness or Readiness()
    snapshot = made_up_scene().snapshot()
    image = answer_image(ImageRequest(preset="head_low"), snapshot, _BUDGET_BYTES)
    if image.status != VIEW_STATUS_RENDERED:
        raise RuntimeError(f"warming up: an image is not rendered: {image.error}")
    unpack_jpeg(image.data)
    readiness.pictures = True
    warm_up_maps()
    for form in ("FORMAT_HEIGHT_MAP", "FORMAT_RANGE_MAP", "FORMAT_CLOUD", "FORMAT_OCTREE"):
        request = ViewRequest(
            format=ViewRequest.Format.Value(form), resolution_m=0.1, width_px=32, height_px=32
        )
        request.min_x_m, request.max_x_m, request.min_y_m, request.max_y_m = -2, 2, -2, 2
        request.time_mode, request.window_s = ViewRequest.TIME_MODE_RELATIVE, 5
        view = answer(request, snapshot, _BUDGET_BYTES)
        if view.status != VIEW_STATUS_RENDERED:
            raise RuntimeError(f"warming up: {form} is not rendered: {view.error}")
        decode_view(view.SerializeToString())
    readiness.geometry = True


def made_up_scene() -> History:
    """Three scans of a wall at three heights, and a picture with an edge."""
    history = History()
    angles = np.linspace(-1.5, 1.5, 200)
    for index in range(3):
        time_ns = (index + 1) * _S
        pose = (0.0, 0.0, 0.4 * index, 0.0, 0.0, 0.0, 1.0)
        history.insert_transforms([StampedTransform(time_ns, "map", "scanner", pose)], time_ns)
        ranges = (1.5 / np.maximum(np.cos(angles), 0.2)).astype(np.float32)
        step_rad = float(angles[1] - angles[0])
        history.insert_scan(RawScan("scan", "scanner", time_ns, 0.0, -1.5, step_rad, ranges), time_ns)
    picture = np.zeros((136, 256, 3), np.uint8)
    picture[40:, 100:] = (40, 120, 200)
    data = cv2.imencode(".jpg", picture)[1].tobytes()
    history.insert_image(CameraFrame("head", "optical", _S, "jpeg", data))
    return history

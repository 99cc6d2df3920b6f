"""Random requests and budgets: `python -m bench.perception_budget [--json] [--pairs 1000]`.

Ten seconds of the synthetic mission's scanner and a frame of each of its cameras; requests of every format,
codec, viewpoint, region, window and fidelity that the schema allows, for geometry and for pictures in turn,
each with a budget of 30 B to 30 kB. A reply keeps to its budget and decodes, or says the smallest that
would do, or names the field that is wrong. The same seed asks the same. Anything else is "broken".
"""

from __future__ import annotations

import argparse
import json
import resource
import sys
import time
from collections import Counter

import cv2
import numpy as np

from bench.perception import fill_history, poses, synthetic_scans
from messages.proto.straitlink.view_pb2 import (
    VIEW_STATUS_DOES_NOT_FIT,
    VIEW_STATUS_NO_DATA,
    VIEW_STATUS_REFUSED,
    VIEW_STATUS_RENDERED,
    Image,
    ImageRegion,
    ImageRequest,
    View,
    ViewRequest,
)
from perception_server.answer import answer
from perception_server.decode import decode_view
from perception_server.foveation import received_image
from perception_server.history import HistorySnapshot
from perception_server.image_answer import answer_image
from perception_server.pictures import Calibration, CameraFrame
from straitlink.synthetic.camera import Pinhole, Renderer
from straitlink.synthetic.fisheye import FisheyeRenderer
from straitlink.synthetic.rigid import transform
from straitlink.synthetic.scene import build_scene
from straitlink.synthetic.settings import START_NS

SEED = 7
_START_S, _DURATION_S = 24.0, 10.0
_LOOK = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
_CHEST_FOV_RAD = float(np.deg2rad(110))
_FORMATS = (1, 2, 3, 4)


def synthetic_history(seed: int = 1) -> HistorySnapshot:
    """Scans of ten seconds, a frame of the head camera, and one of the chest's fisheye."""
    history, _ = fill_history(
        synthetic_scans(seed, _START_S, _DURATION_S, fill=False), poses(seed, _START_S, _DURATION_S)
    )
    scene, pose = build_scene(seed), transform(_LOOK, (0.5, 0.0, 1.4))
    chest = Pinhole(640, 480, 640 / _CHEST_FOV_RAD)
    pictures = {
        "head": Renderer(scene, Pinhole(1024, 544, 610.0), "indoor", seed).expose(pose),
        "chest": FisheyeRenderer(scene, (640, 480), _CHEST_FOV_RAD, "indoor", seed).expose(pose),
    }
    for name, picture in pictures.items():
        data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])[1].tobytes()
        history.insert_image(CameraFrame(name, f"{name}_optical", START_NS + 30_000_000_000, "jpeg", data))
    k = tuple(chest.matrix.ravel().tolist())
    history.insert_calibration(Calibration("chest_optical", 640, 480, "kannala_brandt", (0.0,) * 4, k, k, ()))
    return history.snapshot()


def random_view_request(random: np.random.Generator) -> ViewRequest:
    """Any view: a box of its own size somewhere near the robot, seen in any way."""
    request = ViewRequest(format=int(random.choice(_FORMATS)), codec=int(random.integers(0, 4)))  # type: ignore[arg-type]
    request.source = int(random.choice([1, 2, 3]))  # type: ignore[assignment]
    if request.format == ViewRequest.FORMAT_RANGE_MAP:
        request.projection = int(random.choice([2, 3]))  # type: ignore[assignment]
        request.width_px, request.height_px = (int(each) for each in random.integers(1, 260, 2))
        request.horizontal_fov_rad, request.vertical_fov_rad = random.uniform(0.1, 3.0, 2).tolist()
    else:
        request.resolution_m = float(10 ** random.uniform(-2, 0))
        half_m = request.resolution_m * random.uniform(1, 150, 2)
        request.min_x_m, request.max_x_m = (-half_m[0]).item(), half_m[0].item()
        request.min_y_m, request.max_y_m = (-half_m[1]).item(), half_m[1].item()
    request.frame_id = str(random.choice(["", "map", "head", "lidar"]))
    request.x_m, request.y_m, request.z_m = random.uniform(-3, 3, 3).tolist()
    request.yaw_rad, request.pitch_rad = random.uniform(-1.5, 1.5, 2).tolist()
    request.level = bool(random.random() < 0.5)
    request.time_mode = int(random.choice([1, 2]))  # type: ignore[assignment]
    request.window_s, request.age_s = float(random.uniform(0, 12)), float(random.uniform(0, 3))
    request.max_error_m = float(10 ** random.uniform(-3, -1))
    request.worst_error_m = min(1.0, request.max_error_m * float(random.uniform(1, 20)))
    request.denoise, request.close_gaps = (bool(random.random() < 0.2) for _ in range(2))
    for _ in range(int(random.integers(0, 4))):
        normal = random.normal(size=3)
        normal /= np.linalg.norm(normal)
        x, y, z = normal.tolist()
        request.half_planes.append(
            ViewRequest.HalfPlane(normal_x=x, normal_y=y, normal_z=z, offset_m=float(random.uniform(0, 5)))
        )
    return request


def random_image_request(random: np.random.Generator) -> ImageRequest:
    """Any picture: of either camera, small, straightened, or with chips."""
    request = ImageRequest(source=str(random.choice(["head", "chest"])), grey=bool(random.random() < 0.3))
    request.format = int(random.choice([1, 2, 3]))  # type: ignore[assignment]
    request.quality = int(random.integers(5, 101))
    request.worst_quality = int(random.integers(1, request.quality + 1))
    if random.random() < 0.5:
        request.downsample = int(random.integers(1, 9))
    else:
        request.width_px, request.height_px = (int(each) for each in random.integers(8, 700, 2))
    if request.source == "chest" and random.random() < 0.5:
        request.pan_rad, request.tilt_rad = random.uniform(-0.6, 0.6, 2).tolist()
        request.horizontal_fov_rad = float(random.uniform(0.3, 1.6))
    for _ in range(int(random.integers(0, 4))):
        x, y, width, height = (int(each) for each in random.integers(1, 300, 4))
        request.chips.append(ImageRegion(x_px=x, y_px=y, width_px=width, height_px=height))
    request.chips_only = bool(request.chips) and bool(random.random() < 0.3)
    return request


def outcome(reply: View | Image, budget_bytes: int) -> str:
    """What became of a request, in a few words; "broken" if it is none of what may be."""
    if reply.status == VIEW_STATUS_RENDERED:
        if reply.ByteSize() > budget_bytes:
            return f"broken: {reply.ByteSize()} bytes for {budget_bytes}"
        if isinstance(reply, View):
            decode_view(reply.SerializeToString())
        else:
            received_image(reply)
        return "fits"
    if reply.status == VIEW_STATUS_DOES_NOT_FIT:
        told = reply.error == f"does not fit: smallest is {reply.smallest_bytes} bytes"
        return "does not fit, said so" if told and reply.smallest_bytes > budget_bytes else "broken: not told"
    if reply.status == VIEW_STATUS_NO_DATA and reply.error:
        return "no data, said so"
    if reply.status == VIEW_STATUS_REFUSED and ":" in reply.error:
        return "refused by field"
    return f"broken: {reply.error or reply.status}"


def measure(pairs: int) -> dict[str, object]:
    """Outcomes of so many pairs, geometry and pictures in turn, the slowest reply, and peak memory."""
    snapshot, random = synthetic_history(), np.random.default_rng(SEED)
    found: dict[str, Counter[str]] = {"geometry": Counter(broken=0), "pictures": Counter(broken=0)}
    refusals: Counter[str] = Counter()
    slowest_ms = dict.fromkeys(found, 0.0)
    for index in range(pairs):
        kind = "pictures" if index % 2 else "geometry"
        budget_bytes = int(10 ** random.uniform(1.5, 4.5))
        request = random_image_request(random) if index % 2 else random_view_request(random)
        started = time.thread_time()
        reply: View | Image = (
            answer_image(request, snapshot, budget_bytes)
            if isinstance(request, ImageRequest)
            else answer(request, snapshot, budget_bytes)
        )
        if index > 20:  # kernels are loaded by then
            slowest_ms[kind] = max(slowest_ms[kind], (time.thread_time() - started) * 1e3)
        became = outcome(reply, budget_bytes)
        found[kind]["broken" if became.startswith("broken") else became] += 1
        if became.startswith("broken"):
            print(became, str(request).replace("\n", " "), file=sys.stderr)
        if reply.status == VIEW_STATUS_REFUSED:
            refusals[reply.error.partition(":")[0].partition(" ")[0]] += 1
    return {
        "pairs": pairs,
        "outcomes": {kind: dict(counts) for kind, counts in found.items()},
        "refused_fields": dict(refusals),
        "slowest_cpu_ms": {kind: round(value) for kind, value in slowest_ms.items()},
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024,
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=1000)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    found = measure(arguments.pairs)
    if arguments.json:
        json.dump(found, sys.stdout, indent=1)
        return
    for name, value in found.items():
        print(name, value)


if __name__ == "__main__":
    main()

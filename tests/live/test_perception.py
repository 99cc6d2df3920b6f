"""The perception server on a real bus: queries, questions with a budget, and news of what became of it."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import zenoh
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

from messages.attachment import Stamp, decode_stamp
from messages.proto.straitlink.view_pb2 import Image, ImageRequest
from perception_server.dispatch import Reply, Request, Stream
from perception_server.sensors import SensorHistory
from perception_server.service import PerceptionService, ServiceSettings
from shaper.bus import BusSettings, open_bus
from straitlink.demo.configs import free_addresses
from tests.live.processes import ROOT, wait_until

pytestmark = pytest.mark.live

KEY = "robot/head_camera/image"
STREAM = "robot/view/head"
ENCODING = "application/protobuf;foxglove.CompressedImage"
START_NS = 1_000_000_000_000


class SlowSensors(SensorHistory):
    """Takes a while for each picture, as a large view does."""

    def __init__(self) -> None:
        super().__init__({KEY: "head"})
        self.taken = 0
        self.slow = threading.Event()

    def take(self, key: str, encoding: str, payload: bytes, capture_ns: int, now_ns: int) -> None:
        super().take(key, encoding, payload, capture_ns, now_ns)
        self.taken += 1

    def answer(self, request: Request, budget_bytes: int) -> tuple[Reply, int, int]:
        if self.slow.is_set():
            time.sleep(1.0)
        return super().answer(request, budget_bytes)


class Robot:
    """A bus with a server and a camera, and what is heard on it."""

    def __init__(self) -> None:
        self.endpoint = free_addresses().robot_bus
        self.sessions = [open_bus(BusSettings(listen=[self.endpoint]))]
        self.sessions += [open_bus(BusSettings(connect=[self.endpoint])) for _ in range(2)]
        self.sensors = SlowSensors()
        stream = Stream(STREAM, ImageRequest(preset="head_low"), 200_000_000)
        self.service = PerceptionService(self.sessions[1], ServiceSettings([KEY], [stream]), self.sensors)
        self.bus = self.sessions[2]
        self.views: list[zenoh.Sample] = []
        self.stages: list[tuple[int, str]] = []
        self._listening = [
            self.bus.declare_subscriber("robot/view/**", self.views.append),
            self.bus.declare_subscriber("@straitlink/view/**", self._hear),
        ]
        self._frames = 0

    def _hear(self, sample: zenoh.Sample) -> None:
        told = json.loads(sample.payload.to_bytes())
        self.stages.append((told["request_id"], told["stage"]))

    def expose(self) -> None:
        """The camera takes a frame, 50 ms after the one before."""
        picture = np.full((136, 256, 3), 20 + self._frames % 200, np.uint8)
        data = cv2.imencode(".jpg", picture)[1].tobytes()
        message = CompressedImage(frame_id="optical", format="jpeg", data=data)
        message.timestamp.FromNanoseconds(START_NS + self._frames * 50_000_000)
        self._frames += 1
        stamp = Stamp(time.time_ns(), self._frames).encode()
        self.bus.put(KEY, message.SerializeToString(), encoding=ENCODING, attachment=stamp)

    def expose_and_wait(self) -> None:
        taken = self.sensors.taken
        self.expose()
        wait_until(lambda: self.sensors.taken > taken)

    def close(self) -> None:
        self.service.close()
        for session in reversed(self.sessions):
            session.close()


@pytest.fixture
def robot() -> Iterator[Robot]:
    robot = Robot()
    try:
        wait_until(lambda: bool(robot.sensors.taken) or robot.expose() is not None)
        yield robot
    finally:
        robot.close()


def stream_views(robot: Robot) -> list[zenoh.Sample]:
    return [view for view in robot.views if str(view.key_expr) == STREAM]


def test_a_stream_is_published_until_somebody_pulls_and_then_rendered_to_the_budget_of_the_question(
    robot: Robot,
) -> None:
    wait_until(lambda: bool(stream_views(robot)))
    robot.expose_and_wait()
    robot.expose_and_wait()
    (answer,) = [r.ok for r in robot.bus.get(f"{STREAM}?max_bytes=900", timeout=5) if r.ok is not None]
    assert 0 < len(answer.payload) <= 900
    published = len(stream_views(robot))
    held: list[bytes] = []
    robot.bus.get(f"{STREAM}?max_bytes=900", lambda r: held.append(r.ok.payload.to_bytes() if r.ok else b""))
    time.sleep(0.5)
    assert not held  # nothing new to show: the question waits
    robot.expose()
    wait_until(lambda: bool(held))
    assert Image.FromString(held[0]).frame_ns > Image.FromString(answer.payload.to_bytes()).frame_ns
    assert len(stream_views(robot)) == published  # answers go to who asked


def test_a_request_s_way_is_told_stage_by_stage(robot: Robot) -> None:
    request = ImageRequest(request_id=7, preset="head_low")
    robot.bus.put("operator/image_request", request.SerializeToString())
    wait_until(lambda: (7, "rendered") in robot.stages)
    wait_until(lambda: any(str(view.key_expr) == "robot/view/requested" for view in robot.views))
    view = next(view for view in robot.views if str(view.key_expr) == "robot/view/requested")
    assert Image.FromString(view.payload.to_bytes()).request_id == 7
    assert view.attachment is not None
    stamp = decode_stamp(view.attachment.to_bytes())
    assert (
        stamp is not None and abs(stamp.capture_ns - time.time_ns()) < 10e9
    )  # the bus's clock, not the log's
    receipt = {"topic": "robot/view/requested", "capture_ns": stamp.capture_ns, "sequence": stamp.sequence}
    for stage in ("sent", "delivered"):
        robot.bus.put("@straitlink/receipt/robot/view/requested", json.dumps(receipt | {"stage": stage}))
    wait_until(lambda: (7, "delivered") in robot.stages)
    assert [stage for number, stage in robot.stages if number == 7] == [
        "accepted",
        "rendered",
        "sent",
        "delivered",
    ]


def test_a_slow_render_does_not_keep_the_sensors_waiting(robot: Robot) -> None:
    robot.sensors.slow.set()
    robot.bus.put("operator/image_request", ImageRequest(request_id=7, again=True).SerializeToString())
    wait_until(lambda: (7, "accepted") in robot.stages)
    before, began_s = robot.sensors.taken, time.monotonic()
    for _ in range(20):
        robot.expose()
    wait_until(lambda: robot.sensors.taken >= before + 20, 0.9)
    assert time.monotonic() - began_s < 0.9
    assert (7, "rendered") not in robot.stages


def test_bad_questions_are_answered_with_the_field_at_fault(robot: Robot) -> None:
    for selector, said in (
        (f"{STREAM}?max_bytes=lots", "max_bytes = 'lots'"),
        ("perception/image?preset=head_low;quality=many", "quality = 'many'"),
        ("perception/view?presett=x", "presett: unknown"),
    ):
        (reply,) = robot.bus.get(selector, timeout=5)
        assert reply.err is not None and reply.err.payload.to_string().startswith(said)
    (reply,) = robot.bus.get("perception/image?preset=head_low;quality=500", timeout=5)
    assert reply.ok is not None
    assert Image.FromString(reply.ok.payload.to_bytes()).error == "quality = 500: must be within 1..100"


def test_a_picture_is_requested_from_the_command_line(robot: Robot, tmp_path: Path) -> None:
    out = tmp_path / "head.png"
    command = [sys.executable, "-m", "straitlink", "request", "head_low", "quality=80", "-e", robot.endpoint]
    done = subprocess.run(
        [*command, "--save", str(out)], cwd=ROOT, capture_output=True, text=True, timeout=30
    )
    assert done.returncode == 0, done.stderr
    assert "256x136 at quality 80" in done.stdout
    assert cv2.imread(str(out)).shape == (136, 256, 3)

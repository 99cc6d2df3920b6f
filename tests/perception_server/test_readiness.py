"""What requesters are told, and get, while what draws is still being compiled."""

from __future__ import annotations

from messages.proto.straitlink.view_pb2 import VIEW_STATUS_RENDERED, Image, ImageRequest, ViewRequest
from perception_server.readiness import Readiness, is_warming_up
from perception_server.sensors import SensorHistory
from perception_server.warm_up import warm_up
from tests.perception_server.test_sensors import BUS_NS, FOXGLOVE, KEY, S, compressed

BUDGET_BYTES = 100_000


def cold() -> tuple[SensorHistory, Readiness]:
    readiness = Readiness(pictures=False, geometry=False)
    sensors = SensorHistory({KEY: "head"}, readiness=readiness)
    sensors.take(KEY, FOXGLOVE, compressed(0, 100 * S), BUS_NS, 0)
    return sensors, readiness


def test_a_request_for_geometry_is_told_at_once_to_ask_again_until_it_is_ready() -> None:
    sensors, readiness = cold()
    request = ViewRequest(request_id=7, preset="height_map_scene")
    reply, _, _ = sensors.answer(request, BUDGET_BYTES)
    assert is_warming_up(reply)
    assert reply.request_id == 7
    assert reply.error.endswith("ask again in 5 s")
    readiness.geometry = True
    reply, _, _ = sensors.answer(request, BUDGET_BYTES)
    assert not is_warming_up(reply)  # there is no lidar here: NO_DATA for another reason


def test_pictures_leave_as_plain_jpegs_until_what_packs_them_is_ready() -> None:
    sensors, readiness = cold()
    request = ImageRequest(preset="head_low")
    plain, _, _ = sensors.answer(request, BUDGET_BYTES)
    assert isinstance(plain, Image)
    assert (plain.status, plain.format) == (VIEW_STATUS_RENDERED, ImageRequest.FORMAT_JPEG)
    assert plain.data.startswith(b"\xff\xd8")
    readiness.pictures = True
    packed, _, _ = sensors.answer(request, BUDGET_BYTES)
    assert isinstance(packed, Image)
    assert packed.format == ImageRequest.FORMAT_PACKED_JPEG
    assert len(packed.data) < len(plain.data)


def test_warming_up_makes_everything_ready() -> None:
    readiness = Readiness(pictures=False, geometry=False)
    warm_up(readiness)
    assert readiness == Readiness(pictures=True, geometry=True)

"""What the fuzzer does with views: requests as the robot takes them, pictures as the operator does."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from messages.proto.straitlink.view_pb2 import (
    VIEW_STATUS_RENDERED,
    Image,
    ImageRequest,
    View,
    ViewRequest,
)
from perception_server.bus_messages import IMAGE_ENCODING, VIEW_ENCODING, parse_reply, parse_request
from perception_server.decode import decode_view
from perception_server.decoded import ViewDecoder
from perception_server.dispatch import Dispatcher
from perception_server.errors import RequestError
from perception_server.sensors import check_request
from perception_server.view_codec import (
    DecodeError,
    decode_cloud,
    decode_map,
    decode_octree,
    unpack_jpeg,
    warm_up,
)
from tools.fuzz_parts import join_parts, split_parts

GOLDEN = Path(__file__).resolve().parents[1] / "tests" / "golden"
_DECODERS: tuple[Callable[[bytes], object], ...] = (decode_map, decode_cloud, decode_octree, unpack_jpeg)
load_kernels = warm_up  # what is being compiled would look like a slow input
_REQUESTS = (ViewRequest, ImageRequest)
_S = 1_000_000_000


def picture(data: bytes) -> None:
    """The codecs themselves, by the first byte."""
    if data:
        with suppress(DecodeError):
            _DECODERS[data[0] % len(_DECODERS)](data[1:])


def view(data: bytes) -> None:
    """A View message, and what viewers are shown of it."""
    with suppress(DecodeError):
        decode_view(data)
    ViewDecoder().take(VIEW_ENCODING, data)
    parse_reply(VIEW_ENCODING, data)


def image(data: bytes) -> None:
    """Image messages one after the other: frames, and chips that are drawn on them."""
    decoder = ViewDecoder()
    for part in split_parts(data):
        decoder.take(IMAGE_ENCODING, part)
        parse_reply(IMAGE_ENCODING, part)


def request(data: bytes) -> None:
    """Requests one after the other, and the jobs that come of them."""
    dispatcher, now_ns = Dispatcher((), "robot/view/requested", check_request, lambda status: None), _S
    for part in split_parts(data):
        with suppress(RequestError):
            asked = parse_request(_REQUESTS[len(part) % 2], part)
            dispatcher.request(asked, now_ns)
            dispatcher.query(asked, 1000)
        dispatcher.asked("robot/view/requested", 1000, now_ns)
        dispatcher.next_job(now_ns, lambda wanted: 1)
        dispatcher.wakeup_ns(now_ns)
        now_ns += _S


TARGETS: dict[str, Callable[[bytes], None]] = {
    each.__name__: each for each in (picture, view, image, request)
}


def seeds() -> dict[str, list[bytes]]:
    """True messages of each codec, from the golden ones."""
    maps = _golden("view_maps.json")
    others = _golden("clouds_and_images.json")
    clouds = [data for name, data in others.items() if "CLOUD" in name]
    octrees = [data for name, data in others.items() if "OCTREE" in name]
    packed = [data for name, data in others.items() if "IMAGE" in name]
    kinds = (list(maps.values()), clouds, octrees, packed)
    return {
        "picture": [bytes([which]) + data for which, group in enumerate(kinds) for data in group],
        "view": [
            *(_view(ViewRequest.FORMAT_HEIGHT_MAP, data) for data in maps.values()),
            _view(ViewRequest.FORMAT_RANGE_MAP, next(iter(maps.values()))),
            *(_view(ViewRequest.FORMAT_CLOUD, data) for data in clouds[:2]),
            *(_view(ViewRequest.FORMAT_OCTREE, data) for data in octrees[:2]),
        ],
        "image": [join_parts([each.SerializeToString() for each in _images(others["/jpeg"])])],
        "request": [join_parts([each.SerializeToString() for each in _requests()])],
    }


def _requests() -> tuple[Any, ...]:
    return (
        ViewRequest(request_id=7, format=ViewRequest.FORMAT_HEIGHT_MAP, resolution_m=0.5, period_ms=500),
        ImageRequest(request_id=8, source="head", format=ImageRequest.FORMAT_JPEG, width_px=320),
        ViewRequest(request_id=7, period_ms=-1),
    )


def _images(jpeg: bytes) -> tuple[Image, ...]:
    frame, chip = (
        Image(status=VIEW_STATUS_RENDERED, source="head", full_width_px=64, full_height_px=48) for _ in "ab"
    )
    frame.data = jpeg
    added = chip.chips.add(data=jpeg)
    added.region.width_px, added.region.height_px = 40, 24
    return frame, chip


def _view(form: ViewRequest.Format.ValueType, data: bytes) -> bytes:
    made = View(status=VIEW_STATUS_RENDERED, format=form, data=data, resolution_m=0.1)
    made.horizontal_fov_rad, made.vertical_fov_rad = 1.0, 0.8
    made.world_from_view.SetInParent()
    return made.SerializeToString()


def _golden(name: str) -> dict[str, bytes]:
    """Every message of a file of golden ones, by the names that lead to it."""
    found: dict[str, bytes] = {}

    def walk(at: str, value: Any) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                walk(f"{at}/{key}", inner)
        elif isinstance(value, str):
            with suppress(ValueError):
                found[at] = bytes.fromhex(value)

    walk("", json.loads((GOLDEN / name).read_text()))
    return found

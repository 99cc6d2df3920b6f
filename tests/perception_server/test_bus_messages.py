"""Requests as names and values, and what is on the bus of them."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from messages.proto.straitlink.view_pb2 import Image, ImageRequest, View, ViewRequest
from perception_server.bus_messages import (
    IMAGE_ENCODING,
    VIEW_ENCODING,
    RequestType,
    fields_of,
    parse_reply,
    parse_request,
    request_from_fields,
    status_document,
)
from perception_server.errors import RequestError
from perception_server.request_status import Stage, Status


def test_fields_may_be_texts_as_a_command_line_has_them() -> None:
    fields = {"preset": "head_low", "quality": "40", "grey": "true", "format": "webp", "pan_rad": "-0.25"}
    request = request_from_fields(ImageRequest, fields)
    assert request == ImageRequest(
        preset="head_low", quality=40, grey=True, format=ImageRequest.FORMAT_WEBP, pan_rad=-0.25
    )


def test_fields_may_be_values_as_toml_has_them() -> None:
    region = {"x_px": 3, "y_px": 4, "width_px": 5, "height_px": 6}
    request = request_from_fields(ImageRequest, {"chips": [region], "again": False})
    assert request.chips[0].width_px == 5 and request.HasField("again")
    assert request_from_fields(ViewRequest, {"source": "SOURCE_STEREO"}) == ViewRequest(  # type: ignore[comparison-overlap]
        source=ViewRequest.SOURCE_STEREO
    )


@pytest.mark.parametrize(
    ("kind", "fields", "named"),
    [
        (ImageRequest, {"qualty": 4}, "qualty: unknown; must be one of request_id, preset"),
        (ImageRequest, {"quality": "much"}, "quality = 'much'"),
        (ImageRequest, {"format": "gif"}, "format = 'gif': must be one of FORMAT_UNSPECIFIED, FORMAT_JPEG"),
        (ViewRequest, {"resolution_m": [1]}, "resolution_m = "),
        (ViewRequest, {"level": 3}, "level = 3"),
    ],
)
def test_what_is_no_field_or_no_value_of_it_is_named(
    kind: RequestType, fields: dict[str, object], named: str
) -> None:
    with pytest.raises(RequestError) as refused:
        request_from_fields(kind, fields)
    assert str(refused.value).startswith(named)


@given(st.binary(max_size=100))
def test_any_bytes_are_a_request_or_refused_and_a_reply_or_none(data: bytes) -> None:
    for kind in (ImageRequest, ViewRequest):
        try:
            assert isinstance(parse_request(kind, data), kind)
        except RequestError as error:
            assert str(error).startswith("request: ")
    for encoding in (IMAGE_ENCODING, VIEW_ENCODING, "application/json"):
        assert isinstance(parse_reply(encoding, data), Image | View | None)


def test_a_request_as_large_as_a_picture_is_refused() -> None:
    with pytest.raises(RequestError, match="request: 5000 bytes: must be at most 4096"):
        parse_request(ImageRequest, bytes(5000))


def test_a_selector_s_parameters_are_fields() -> None:
    assert fields_of("preset=head_low;max_bytes=5;_time=[now()]") == {"preset": "head_low", "max_bytes": "5"}
    assert fields_of("") == {}


def test_a_status_says_what_is_known() -> None:
    told = json.loads(status_document(Status(7, Stage.SENT, "robot/view/requested", size_bytes=900)))
    assert told == {"request_id": 7, "stage": "sent", "key": "robot/view/requested", "size_bytes": 900}

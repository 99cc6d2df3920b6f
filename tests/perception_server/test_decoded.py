"""What an operator's viewers and files get of a view."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.Grid_pb2 import Grid
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from hypothesis import given, settings
from hypothesis import strategies as st

from messages.proto.straitlink.view_pb2 import Image, ImageRequest, View, ViewRequest
from perception_server.answer import answer
from perception_server.bus_messages import IMAGE_ENCODING, VIEW_ENCODING
from perception_server.decode import decode_view_message
from perception_server.decoded import ViewDecoder
from perception_server.image_answer import answer_image
from perception_server.picture_file import decode_picture
from perception_server.view_picture import ply, view_picture
from perception_server.warm_up import made_up_scene, warm_up

SCENE = made_up_scene().snapshot()


def view(form: str = "FORMAT_HEIGHT_MAP") -> View:
    request = ViewRequest(format=ViewRequest.Format.Value(form), resolution_m=0.1, width_px=32, height_px=24)
    request.min_x_m, request.max_x_m, request.min_y_m, request.max_y_m = -2, 3, -2, 2
    request.time_mode, request.window_s = ViewRequest.TIME_MODE_RELATIVE, 5
    return answer(request, SCENE, 100_000)


def image(**said: object) -> Image:
    return answer_image(ImageRequest(**said), SCENE, 100_000)  # type: ignore[arg-type]


def test_a_base_picture_reaches_viewers_as_the_very_file_that_was_sent() -> None:
    sent = image(preset="head_low", format=ImageRequest.FORMAT_JPEG)
    (shown,) = ViewDecoder().take(IMAGE_ENCODING, sent.SerializeToString())
    message = CompressedImage.FromString(shown.payload)
    assert (shown.what, message.format, message.data) == ("image", "jpeg", sent.data)
    assert message.timestamp.ToNanoseconds() == sent.frame_ns and message.frame_id == sent.frame_id


def test_a_foveated_picture_reaches_viewers_without_loss_at_full_resolution() -> None:
    sent = image(
        preset="head_low", downsample=4, chips=[{"x_px": 80, "y_px": 20, "width_px": 60, "height_px": 50}]
    )
    (shown,) = ViewDecoder().take(IMAGE_ENCODING, sent.SerializeToString())
    message = CompressedImage.FromString(shown.payload)
    seen = cv2.imdecode(np.frombuffer(message.data, np.uint8), cv2.IMREAD_COLOR)
    assert message.format == "png" and seen.shape == (136, 256, 3)
    chip = decode_picture(sent.chips[0].data).astype(int)
    assert np.abs(seen[20:70, 80:140] - chip).max() <= 1


def test_a_chip_alone_shows_nothing_until_its_base_is_there() -> None:
    decoder = ViewDecoder()
    chip = image(chips_only=True, chips=[{"width_px": 60, "height_px": 50}])
    assert decoder.take(IMAGE_ENCODING, chip.SerializeToString()) == ()
    (shown,) = decoder.take(IMAGE_ENCODING, image(preset="head_low").SerializeToString())
    assert CompressedImage.FromString(shown.payload).format == "png"


def test_a_height_map_reaches_viewers_as_a_grid_and_a_cloud_and_the_others_as_clouds() -> None:
    decoder = ViewDecoder()
    grid, cloud = decoder.take(VIEW_ENCODING, view().SerializeToString())
    assert Grid.FromString(grid.payload).column_count == 50
    assert len(PointCloud.FromString(cloud.payload).data) > 0
    for form in ("FORMAT_RANGE_MAP", "FORMAT_CLOUD", "FORMAT_OCTREE"):
        assert [s.what for s in decoder.take(VIEW_ENCODING, view(form).SerializeToString())] == ["cloud"]


def test_replies_without_a_picture_and_other_messages_show_nothing() -> None:
    decoder = ViewDecoder()
    assert decoder.take(VIEW_ENCODING, View(error="no data").SerializeToString()) == ()
    assert decoder.take("application/json", b"{}") == ()
    assert decoder.refused == 0


SENT = ((VIEW_ENCODING, view().SerializeToString()), (IMAGE_ENCODING, image().SerializeToString()))


@settings(max_examples=100)
@given(st.sampled_from(SENT), st.binary(min_size=1, max_size=40), st.integers(0, 3000))
def test_damaged_messages_are_counted_and_the_next_is_shown(
    sent: tuple[str, bytes], noise: bytes, at: int
) -> None:
    encoding, sound = sent
    at %= len(sound)
    decoder = ViewDecoder()
    shown = decoder.take(encoding, sound[:at] + noise + sound[at + len(noise) :])
    assert shown or decoder.refused <= 1
    assert decoder.take(encoding, sound)


FORMS = ("FORMAT_HEIGHT_MAP", "FORMAT_RANGE_MAP", "FORMAT_CLOUD", "FORMAT_OCTREE")
ALL_SENT = (*((VIEW_ENCODING, view(form).SerializeToString()) for form in FORMS), SENT[1])


@settings(max_examples=40)
@given(st.lists(st.sampled_from(ALL_SENT), max_size=8))
def test_whatever_is_lost_doubled_or_reordered_the_rest_shows_as_if_it_were_alone(
    arriving: list[tuple[str, bytes]],
) -> None:
    decoder = ViewDecoder()
    for each in arriving:
        assert decoder.take(*each) == ALONE[each]
    assert decoder.refused == 0


ALONE = {each: ViewDecoder().take(*each) for each in ALL_SENT}


@pytest.mark.parametrize("form", ["FORMAT_HEIGHT_MAP", "FORMAT_RANGE_MAP", "FORMAT_CLOUD", "FORMAT_OCTREE"])
def test_every_view_can_be_looked_at_and_its_points_are_read_by_others(form: str) -> None:
    decoded = decode_view_message(view(form))
    picture = view_picture(decoded)
    assert picture.dtype == np.uint8 and picture.ndim == 3
    shown = (picture != (40, 40, 40)).any(axis=-1)
    assert shown.any() and not shown.all()
    header, _, body = ply(decoded).partition(b"end_header\n")
    count = len(decoded.points_m)
    assert f"element vertex {count}\n".encode() in header
    np.testing.assert_array_equal(np.frombuffer(body, "<f8").reshape(count, 3), decoded.world_points_m)


def test_in_a_height_map_s_picture_left_is_up_and_forward_is_right() -> None:
    decoded = decode_view_message(view())
    assert decoded.values is not None
    picture = view_picture(decoded)
    hole = (picture[::3, ::3] == (40, 40, 40)).all(axis=-1)
    np.testing.assert_array_equal(hole, np.isnan(decoded.values)[::-1])


def test_warming_up_renders_one_of_each() -> None:
    warm_up()

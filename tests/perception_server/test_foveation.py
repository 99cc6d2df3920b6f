"""Chips on the frame that they were cut from, and on no other."""

from __future__ import annotations

import random
import resource
import time
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from messages.proto.straitlink.view_pb2 import VIEW_STATUS_NO_DATA, Image, ImageRegion, ImageRequest
from perception_server.fisheye import Picture
from perception_server.foveation import (
    Composite,
    Compositor,
    paste_marked,
    read_image,
    received_image,
)
from perception_server.image_wish import image_wish
from perception_server.images import render_image
from perception_server.picture_file import decode_picture
from perception_server.view_codec import DecodeError
from tests.perception_server.camera_frames import chest_camera, chest_frame, head_frame

PLENTY = 10_000_000
FIRST = ImageRegion(x_px=300, y_px=200, width_px=200, height_px=160)
SECOND = ImageRegion(x_px=700, y_px=40, width_px=120, height_px=90)


def image(
    step: int = 0, *, base: bool = True, chips: tuple[ImageRegion, ...] = (), form: str = "FORMAT_JPEG"
) -> Image:
    request = ImageRequest(preset="head_low", chips=chips, chips_only=not base)
    request.format = ImageRequest.Format.Value(form)
    return render_image(image_wish(request), head_frame(step), None, PLENTY)


def take(compositor: Compositor, *images: Image) -> Composite:
    composites = [compositor.take(read_image(each.SerializeToString())) for each in images]
    return composites[-1]


def cut(picture: Picture | None, region: ImageRegion) -> Picture:
    assert picture is not None
    rows = slice(region.y_px, region.y_px + region.height_px)
    return picture[rows, region.x_px : region.x_px + region.width_px]


def assert_shows(composite: Composite, sent: Image, index: int = 0) -> None:
    """Within a grey level of the chip as it was sent: no second generation of loss."""
    reference = decode_picture(sent.chips[index].data).astype(int)
    shown = cut(composite.picture, sent.chips[index].region)
    assert np.abs(shown - reference).max() <= 1


@pytest.mark.parametrize("form", ["FORMAT_JPEG", "FORMAT_PACKED_JPEG", "FORMAT_WEBP"])
def test_base_and_chips_of_one_message_make_one_picture_at_full_resolution(form: str) -> None:
    sent = image(chips=(FIRST, SECOND), form=form)
    composite = take(Compositor(), sent)
    assert composite.picture is not None and composite.picture.shape == (544, 1024, 3)
    assert_shows(composite, sent, 0)
    assert_shows(composite, sent, 1)
    assert len(composite.pasted) == 2 and not composite.others


def test_outside_of_the_chips_the_base_is_seen_in_colour() -> None:
    composite = take(Compositor(), image(chips=(FIRST,)))
    source = cv2.imdecode(np.frombuffer(head_frame().data, np.uint8), cv2.IMREAD_COLOR)
    outside = np.ones(source.shape[:2], bool)
    cut(outside, FIRST)[:] = False
    assert composite.picture is not None
    error = np.abs(composite.picture.astype(int) - source)
    assert error[outside].mean() < 15 and error[~outside].mean() < error[outside].mean() / 1.5


@pytest.mark.parametrize("chip_first", [False, True])
def test_base_and_chip_find_each_other_in_either_order(chip_first: bool) -> None:
    base, chip = image(), image(base=False, chips=(FIRST,))
    parts = (chip, base) if chip_first else (base, chip)
    compositor = Compositor()
    first = take(compositor, parts[0])
    assert (first.picture is None) == chip_first and not first.pasted
    assert_shows(take(compositor, parts[1]), chip)


def test_a_chip_of_another_frame_is_told_and_not_pasted() -> None:
    compositor = Compositor()
    chip = image(0, base=False, chips=(FIRST,))
    take(compositor, chip)
    composite = take(compositor, image(1))
    alone = take(Compositor(), image(1))
    np.testing.assert_array_equal(composite.picture, alone.picture)
    assert composite.pasted == ()
    (other,) = composite.others
    assert other.frame_ns == head_frame(0).capture_ns
    assert other.later_by_ns == head_frame(0).capture_ns - head_frame(1).capture_ns == -1_000_000_000


def test_a_chip_that_comes_late_goes_onto_its_own_frame_still() -> None:
    compositor = Compositor()
    take(compositor, image(0), image(1))
    chip = image(0, base=False, chips=(FIRST,))
    composite = take(compositor, chip)
    assert composite.key.frame_ns == head_frame(0).capture_ns
    assert_shows(composite, chip)


def test_who_wants_a_chip_of_another_time_gets_it_framed_on_a_copy() -> None:
    compositor = Compositor()
    take(compositor, image(0, base=False, chips=(FIRST,)))
    composite = take(compositor, image(1))
    marked = paste_marked(composite, composite.others[0])
    assert composite.picture is not None
    assert tuple(cut(marked, FIRST)[0, 0]) == (0, 0, 255) != tuple(cut(composite.picture, FIRST)[0, 0])


def test_a_chip_of_the_same_instant_of_another_camera_is_not_pasted() -> None:
    compositor = Compositor()
    chip = image(0, base=False, chips=(FIRST,))
    chip.source = "tail"
    take(compositor, chip)
    composite = take(compositor, image(0))
    assert not composite.pasted and not composite.others


def test_chips_of_a_straight_view_belong_to_that_direction() -> None:
    def straight(pan_rad: float, **said: object) -> Image:
        request = ImageRequest(preset="chest", pan_rad=pan_rad, **said)  # type: ignore[arg-type]
        return render_image(image_wish(request), chest_frame(), chest_camera(), PLENTY)

    region = ImageRegion(x_px=60, y_px=80, width_px=100, height_px=90)
    together = straight(0.1, chips=[region])
    assert together.full_width_px > 256 == together.width_px
    assert_shows(take(Compositor(), together), together)
    compositor = Compositor()
    take(compositor, straight(0.3, chips=[region], chips_only=True))
    assert not take(compositor, together).others


@settings(max_examples=25, deadline=None)
@given(st.randoms(use_true_random=False))
def test_lost_doubled_and_reordered_messages_leave_the_rest_right(shuffled: random.Random) -> None:
    sent = [
        image(0),
        image(0, base=False, chips=(FIRST,)),
        image(1, chips=(SECOND,)),
        image(1, base=False, chips=(FIRST,)),
    ]
    arriving = [each for each in sent for _ in range(shuffled.randrange(3))]
    shuffled.shuffle(arriving)
    compositor = Compositor()
    for each in arriving:
        composite = take(compositor, each)
        for index in range(len(each.chips) if composite.picture is not None else 0):
            assert_shows(composite, each, index)
        assert all(other.frame_ns != each.frame_ns for other in composite.others)


def test_what_is_kept_is_bounded() -> None:
    compositor = Compositor()
    sent = image(0)
    keys = []
    for _ in range(20):
        sent.frame_ns += 1
        keys.append(take(compositor, sent).key)
    kept = [key for key in keys if compositor.compose(key) is not None]
    assert kept == keys[-8:]
    for number in range(40):
        sent.source = f"camera{number}"
        keys.append(take(compositor, sent).key)
    assert len([key for key in keys if compositor.compose(key) is not None]) <= 32 + 8


# Hostile messages.


def change(what: Callable[[Image], object]) -> bytes:
    sent = image(chips=(FIRST,))
    what(sent)
    return sent.SerializeToString()


def _set(sent: Image, **values: object) -> None:
    for name, value in values.items():
        setattr(sent, name, value)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff" * 40,
        change(lambda sent: _set(sent, full_width_px=60_000, full_height_px=60_000)),
        change(lambda sent: _set(sent, full_width_px=0)),
        change(lambda sent: _set(sent, full_width_px=400)),  # the chip is outside
        change(lambda sent: _set(sent, status=VIEW_STATUS_NO_DATA)),
        change(lambda sent: [sent.ClearField("data"), sent.ClearField("chips")]),
        change(lambda sent: _set(sent, data=b"junk")),
        change(lambda sent: _set(sent, data=sent.data[:20])),
        change(lambda sent: _set(sent, source="x" * 1000)),
        change(lambda sent: sent.chips.extend([sent.chips[0]] * 40)),
        change(lambda sent: _set(sent.chips[0].region, width_px=0)),
        change(lambda sent: _set(sent.chips[0].region, width_px=100)),  # not the picture's size
        change(lambda sent: _set(sent.chips[0], data=b"")),
    ],
)
def test_a_hostile_image_is_a_decode_error_and_changes_nothing(data: bytes) -> None:
    compositor = Compositor()
    before = take(compositor, image(1, chips=(FIRST,)))
    with pytest.raises(DecodeError):
        compositor.take(read_image(data))
    after = compositor.compose(before.key)
    assert after is not None and after.others == before.others
    np.testing.assert_array_equal(after.picture, before.picture)


@settings(max_examples=150, deadline=None)
@given(st.binary(max_size=200), st.integers(0, 5000), st.integers(0, 400))
def test_any_damage_is_a_decode_error_or_a_picture(noise: bytes, at: int, cut_bytes: int) -> None:
    sound = DAMAGED
    data = sound[: at % len(sound)] + noise + sound[at % len(sound) + cut_bytes :]
    try:
        composite = Compositor().take(read_image(data))
    except DecodeError:
        return
    assert composite.picture is None or composite.picture.ndim == 3


DAMAGED = image(chips=(SECOND,)).SerializeToString()


def test_a_small_file_that_claims_to_be_huge_costs_no_memory() -> None:
    jpeg = cv2.imencode(".jpg", np.zeros((64, 64, 3), np.uint8))[1].tobytes()
    at = jpeg.index(b"\xff\xc0") + 5
    bomb = jpeg[:at] + (15_000).to_bytes(2, "big") * 2 + jpeg[at + 4 :]  # 675 MB as pixels
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(DecodeError, match="15000x15000 has more than"):
        Compositor().take(received_image(Image.FromString(change(lambda sent: _set(sent, data=bomb)))))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb < 64_000


def test_a_progressive_file_with_endless_scans_is_refused_at_once() -> None:
    picture = np.zeros((1024, 1024, 3), np.uint8)
    jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    last_scan = jpeg[jpeg.rfind(b"\xff\xda") : -2]
    began_s = time.process_time()
    with pytest.raises(DecodeError, match="scans"):
        decode_picture(jpeg[:-2] + last_scan * 20_000 + jpeg[-2:])
    assert time.process_time() - began_s < 2

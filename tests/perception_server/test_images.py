"""Pictures as they were asked for, within the bytes that there are."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from messages.proto.straitlink.view_pb2 import (
    VIEW_STATUS_DOES_NOT_FIT,
    VIEW_STATUS_RENDERED,
    Image,
    ImageRegion,
    ImageRequest,
)
from perception_server.errors import NoDataError, RequestError
from perception_server.image_wish import IMAGE_PRESETS, ImageWish, Region, image_wish
from perception_server.images import render_image
from perception_server.picture_file import MAX_PIXELS, decode_picture
from perception_server.pictures import CameraFrame
from tests.perception_server.camera_frames import chest_camera, chest_frame, head_frame, head_picture

PLENTY = 10_000_000


def render(request: ImageRequest, budget_bytes: int = PLENTY, frame: CameraFrame | None = None) -> Image:
    return render_image(image_wish(request), frame or head_frame(), chest_camera(), budget_bytes, 7)


@pytest.mark.parametrize(
    ("preset", "size", "quality"), [("head_low", (256, 136), 50), ("head_high", (512, 272), 50)]
)
def test_the_products_of_the_head_camera_have_their_sizes(
    preset: str, size: tuple[int, int], quality: int
) -> None:
    image = render(ImageRequest(preset=preset))
    assert (image.width_px, image.height_px, image.quality) == (*size, quality)
    assert decode_picture(image.data).shape == (size[1], size[0], 3)
    assert (image.source, image.frame_ns, image.request_id) == ("head", head_frame().capture_ns, 7)
    assert not image.coarsened and not image.chips


def test_the_chest_product_is_a_straight_view_of_its_size() -> None:
    image = render(ImageRequest(preset="chest"), frame=chest_frame())
    assert (image.width_px, image.height_px) == (256, 320)
    assert decode_picture(image.data).shape == (320, 256, 3)
    assert image.horizontal_fov_rad == pytest.approx(1.1)


def test_a_chip_has_full_resolution() -> None:
    chip = ImageRegion(x_px=300, y_px=200, width_px=160, height_px=120)
    image = render(
        ImageRequest(preset="chip", chips=[chip], chip_quality=100, format=ImageRequest.FORMAT_JPEG)
    )
    assert not image.data and image.chips[0].quality == 100
    seen = decode_picture(image.chips[0].data).astype(int)
    source = cv2.imdecode(np.frombuffer(head_frame().data, np.uint8), cv2.IMREAD_COLOR)
    assert np.abs(seen - source[200:320, 300:460]).mean() < 3  # chroma is halved


def test_a_chip_without_a_region_is_in_the_middle_and_two_hundred_pixels_wide() -> None:
    image = render(ImageRequest(preset="chip"))
    region = image.chips[0].region
    assert (region.x_px, region.y_px, region.width_px, region.height_px) == (412, 172, 200, 200)
    assert image.chips[0].quality == 70


def test_a_request_changes_what_its_preset_says() -> None:
    image = render(ImageRequest(preset="head_low", downsample=8, quality=30, grey=True))
    assert (image.width_px, image.height_px, image.quality, image.grey) == (128, 68, 30, True)
    assert decode_picture(image.data).ndim == 2


def test_without_any_wish_a_quarter_of_each_side_crosses_at_quality_fifty() -> None:
    image = render(ImageRequest())
    assert (image.width_px, image.height_px, image.quality) == (256, 136, 50)
    assert image.format == ImageRequest.FORMAT_JPEG and image.data.startswith(b"\xff\xd8")


def test_small_pictures_are_of_the_frame_and_not_mirrored_or_shifted() -> None:
    seen = decode_picture(render(ImageRequest(preset="head_high", quality=95)).data).astype(int)
    expected = cv2.resize(head_picture(), (512, 272), interpolation=cv2.INTER_AREA)
    assert np.abs(seen - expected).mean() < 4


@pytest.mark.parametrize("form", ["FORMAT_JPEG", "FORMAT_PACKED_JPEG", "FORMAT_WEBP"])
def test_every_format_decodes_alone(form: str) -> None:
    image = render(ImageRequest(format=ImageRequest.Format.Value(form), width_px=256))
    assert decode_picture(image.data).shape == (136, 256, 3)


def test_packed_pictures_are_smaller_and_have_the_same_pixels() -> None:
    plain, packed = (
        render(ImageRequest(preset="head_low", format=form))
        for form in (ImageRequest.FORMAT_JPEG, ImageRequest.FORMAT_PACKED_JPEG)
    )
    np.testing.assert_array_equal(decode_picture(plain.data), decode_picture(packed.data))
    assert len(packed.data) < 0.96 * len(plain.data)


# Budgets.


def test_a_budget_lowers_the_quality_before_it_shrinks_the_picture() -> None:
    whole = render(ImageRequest(preset="head_low"))
    less = render(ImageRequest(preset="head_low"), whole.ByteSize() * 2 // 3)
    least = render(ImageRequest(preset="head_low"), whole.ByteSize() // 5)
    assert less.width_px == 256 and less.quality < 50 and less.coarsened
    assert least.width_px < 256 and least.quality == 10 and least.coarsened


def test_what_does_not_fit_is_told_with_the_smallest_that_would() -> None:
    refused = render(ImageRequest(preset="head_low"), 100)
    assert refused.status == VIEW_STATUS_DOES_NOT_FIT and not refused.data
    assert refused.error == f"does not fit: smallest is {refused.smallest_bytes} bytes"
    assert render(ImageRequest(preset="head_low"), refused.smallest_bytes).status == VIEW_STATUS_RENDERED


@settings(max_examples=30, deadline=None)
@given(
    st.sampled_from([None, *IMAGE_PRESETS]),
    st.integers(100, 30_000),
    st.integers(1, 100),
    st.integers(1, 16),
    st.integers(0, 3),
    st.booleans(),
    st.booleans(),
)
def test_a_reply_is_within_its_budget_or_says_what_would_be(
    preset: str | None, budget: int, quality: int, downsample: int, chips: int, only: bool, looks: bool
) -> None:
    request = ImageRequest(preset=preset, quality=quality, downsample=downsample, chips_only=only)
    for index in range(chips):
        request.chips.add(x_px=50 * index, y_px=10, width_px=40, height_px=60)
    if looks:
        request.horizontal_fov_rad = 0.9
    image = render(request, budget, chest_frame())
    if image.status == VIEW_STATUS_RENDERED:
        assert image.ByteSize() <= budget
    else:
        assert image.status == VIEW_STATUS_DOES_NOT_FIT and image.smallest_bytes > budget
        assert render(request, image.smallest_bytes, chest_frame()).status == VIEW_STATUS_RENDERED


# What cannot be.


@pytest.mark.parametrize(
    ("request_", "named"),
    [
        (ImageRequest(quality=101), "quality = 101: must be within 1..100"),
        (ImageRequest(downsample=65), "downsample = 65"),
        (ImageRequest(preset="tail"), "preset = 'tail': must be one of head_low"),
        (ImageRequest(pan_rad=0.3), "pan_rad: .*horizontal_fov_rad"),
        (ImageRequest(horizontal_fov_rad=math.nan), "horizontal_fov_rad = nan"),
        (ImageRequest(quality=20, worst_quality=30), "worst_quality = 30: must be at most quality = 20"),
        (ImageRequest(chips=[ImageRegion(x_px=9)]), r"chips\[0\].width_px: is missing"),
        (ImageRequest(chips=[ImageRegion(width_px=9999)]), r"chips\[0\].width_px = 9999"),
        (
            ImageRequest(chips=[ImageRegion(width_px=9, height_px=9)] * 5),
            "chips: 5 of them: must be at most 4",
        ),
        (ImageRequest(preset="x" * 50), "preset = .*must be at most 32 bytes"),
        (ImageRequest(format=9), "format = 9: must be one of FORMAT"),  # type: ignore[arg-type]
        (ImageRequest(format=ImageRequest.FORMAT_AVIF), "format = FORMAT_AVIF: is not offered"),
    ],
)
def test_a_request_out_of_bounds_is_refused_by_field(request_: ImageRequest, named: str) -> None:
    with pytest.raises(RequestError, match=f"^{named}"):
        image_wish(request_)


def test_a_chip_outside_of_the_picture_is_refused_by_field() -> None:
    request = ImageRequest(chips=[ImageRegion(x_px=900, y_px=0, width_px=200, height_px=50)])
    with pytest.raises(RequestError, match=r"^chips\[0\] = 200x50 at \(900, 0\).*1024x544"):
        render(request)


def test_a_straight_view_needs_a_calibration() -> None:
    with pytest.raises(RequestError, match=r"^horizontal_fov_rad = 1\.1: chest has no calibration"):
        render_image(image_wish(ImageRequest(preset="chest")), chest_frame(), None, PLENTY)


@pytest.mark.parametrize("data", [b"", b"no picture", head_frame().data[:300]])
def test_a_frame_that_is_no_picture_is_told_as_missing_data(data: bytes) -> None:
    with pytest.raises(NoDataError, match="head: frame 5 is unreadable"):
        render_image(ImageWish(), CameraFrame("head", "optical", 5, "jpeg", data), None, PLENTY)


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "bgra8", "mono8"])
def test_raw_frames_show_as_they_are(encoding: str) -> None:
    picture = cv2.resize(head_picture(), (64, 34), interpolation=cv2.INTER_AREA)
    codes = {"rgb8": cv2.COLOR_BGR2RGB, "rgba8": cv2.COLOR_BGR2RGBA, "bgra8": cv2.COLOR_BGR2BGRA}
    codes["mono8"] = cv2.COLOR_BGR2GRAY
    raw = cv2.cvtColor(picture, codes[encoding]) if encoding in codes else picture
    padded = np.zeros((34, raw[0].size + 5), np.uint8)
    padded[:, :-5] = raw.reshape(34, -1)
    frame = CameraFrame("head", "optical", 5, encoding, padded.tobytes(), 64, 34, padded.shape[1])
    seen = decode_picture(render_image(ImageWish(downsample=1, quality=98), frame, None, PLENTY).data)
    expected = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY) if encoding == "mono8" else picture
    assert np.abs(seen.astype(int) - expected).mean() < 3


def test_raw_frames_that_are_too_short_are_told_as_missing_data() -> None:
    with pytest.raises(NoDataError, match="10 bytes are not 64x34 pixels of rgb8"):
        render_image(ImageWish(), CameraFrame("head", "o", 5, "rgb8", bytes(10), 64, 34), None, PLENTY)


def test_a_camera_of_more_pixels_than_may_cross_is_taken_at_half() -> None:
    frame = CameraFrame("wide", "o", 5, "mono8", bytes(4096 * 1200), 4096, 1200)
    image = render_image(ImageWish(chips=(Region(0, 0, 8, 8),)), frame, None, PLENTY)
    assert (image.full_width_px, image.full_height_px) == (2048, 600)
    assert image.full_width_px * image.full_height_px <= MAX_PIXELS

"""Pictures at a quality or within a budget, and clouds as Draco."""

from __future__ import annotations

import sys

import cv2
import numpy as np
import pytest

from perception_server.view_codec import (
    EncodeError,
    encode_cloud,
    encode_draco,
    encode_image,
    unpack_jpeg,
    warm_up,
)
from perception_server.view_codec.compiled import IS_COMPILED
from perception_server.view_codec.image import ImageFormat
from perception_server.view_codec.jpeg_context import _code_plane
from perception_server.view_codec.jpeg_scan import _read_mcus, _write_mcus
from perception_server.view_codec.occupancy_context import _code_level
from tests.perception_server.view_codec.clouds import room_cloud
from tests.perception_server.view_codec.test_jpeg import picture

FORMATS: list[ImageFormat] = ["jpeg", "webp"]


@pytest.mark.parametrize("format", FORMATS)
@pytest.mark.parametrize("grey", [False, True])
def test_a_picture_comes_back_alike_from_its_file(format: ImageFormat, grey: bool) -> None:
    image = picture(96, 64, grey=grey)
    file = unpack_jpeg(encode_image(image, format, quality=80))
    shown = cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_GRAYSCALE if grey else cv2.IMREAD_COLOR)
    assert shown.shape == image.shape
    assert cv2.PSNR(shown, image) > 28


@pytest.mark.parametrize("format", FORMATS)
def test_a_budget_is_kept_and_used(format: ImageFormat) -> None:
    image = picture(96, 64)
    for max_bytes in (900, 2000):
        assert 0.75 * max_bytes < len(encode_image(image, format, max_bytes=max_bytes)) <= max_bytes
    assert encode_image(image, format, 30, 50_000) == encode_image(image, format, 30)


@pytest.mark.parametrize(
    ("image", "wish", "said"),
    [
        (picture(), {"max_bytes": 20}, "max_bytes = 20"),
        (picture(), {"quality": 0}, "outside 1..100"),
        (picture(), {"format": "avif"}, "must be one of jpeg, webp"),
        (picture().astype(np.float32), {}, "must be uint8"),
        (np.zeros((0, 5), np.uint8), {}, "sides of 1"),
    ],
)
def test_what_cannot_be_written_is_refused_in_a_sentence(
    image: np.ndarray, wish: dict[str, object], said: str
) -> None:
    with pytest.raises(EncodeError, match=said):
        encode_image(image, **wish)  # type: ignore[arg-type]


def test_draco_holds_the_cloud_within_its_error() -> None:
    draco = pytest.importorskip("DracoPy")
    cloud = room_cloud(500)
    holed = np.concatenate([cloud, [[np.nan, 0, 0]]])
    decoded = np.asarray(draco.decode(encode_draco(holed, max_error_m=0.01)).points)
    assert decoded.shape == cloud.shape
    apart = np.linalg.norm(decoded[:, None] - cloud[None], axis=2)
    assert max(apart.min(axis=0).max(), apart.min(axis=1).max()) <= 0.01 + 1e-6
    assert len(encode_draco(cloud, bits=8)) < len(encode_draco(cloud, bits=12))
    assert len(draco.decode(encode_draco(np.ones((3, 3)), max_error_m=0.1)).points) == 1


@pytest.mark.parametrize(
    ("cloud", "wish", "said"),
    [
        (np.zeros((0, 3)), {"bits": 8}, "at least one"),
        (room_cloud(5), {}, "exactly one"),
        (room_cloud(5), {"bits": 21}, "outside 1..20"),
        (room_cloud(5), {"max_error_m": 0.0}, "above 0"),
        (room_cloud(5), {"max_error_m": 1e-9}, "outside 1..20"),
    ],
)
def test_draco_refuses_in_a_sentence(cloud: np.ndarray, wish: dict[str, float], said: str) -> None:
    pytest.importorskip("DracoPy")
    with pytest.raises(EncodeError, match=said):
        encode_draco(cloud, **wish)  # type: ignore[arg-type]


def test_without_the_draco_extra_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    with pytest.raises(EncodeError, match="straitlink\\[draco\\]"):
        encode_draco(room_cloud(5), bits=8)


def test_the_warm_up_leaves_nothing_to_compile() -> None:
    warm_up()
    assert compiled_kernels() > 0 or not IS_COMPILED
    before = compiled_kernels()
    encode_image(picture(40, 40))
    encode_cloud(room_cloud(50), bits=8)
    assert compiled_kernels() == before


def compiled_kernels() -> int:
    """How many kernels of clouds and JPEGs are compiled."""
    kernels = (_code_plane, _code_level, _read_mcus, _write_mcus)
    return sum(len(getattr(kernel, "signatures", ())) for kernel in kernels)

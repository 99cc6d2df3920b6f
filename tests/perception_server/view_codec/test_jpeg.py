"""JPEGs travel smaller and come back as files of the same pixels."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from perception_server.view_codec import CodecId, DecodeError, EncodeError, pack_jpeg, unpack_jpeg

Picture = NDArray[np.uint8]

SAMPLINGS = {"4:4:4": 0x111111, "4:2:2": 0x211111, "4:2:0": 0x221111, "4:4:0": 0x121111, "4:1:1": 0x411111}


def picture(width: int = 256, height: int = 136, seed: int = 0, grey: bool = False) -> Picture:
    """Edges, gradients and grain, as a camera sees them."""
    random = np.random.default_rng(seed)
    shape = (height, width, 3)
    y, x = np.mgrid[0:height, 0:width]
    base = np.stack([90 + 40 * np.sin(x / 17 + k) + 30 * np.cos(y / 11 - k) for k in range(3)], axis=2)
    for _ in range(6):
        top, left = random.integers(0, height), random.integers(0, width)
        base[top : top + height // 3, left : left + width // 4] += random.normal(0, 60, 3)
    noisy = np.clip(base + random.normal(0, 5, shape), 0, 255).astype(np.uint8)
    return noisy[:, :, 0] if grey else noisy


def jpeg_of(image: Picture, quality: int = 50, *, sampling: str = "4:2:0", **wishes: int) -> bytes:
    """OpenCV's JPEG; wishes are names of its parameters after IMWRITE_JPEG_."""
    parameters = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, SAMPLINGS[sampling]]
    for name, value in wishes.items():
        parameters += [getattr(cv2, f"IMWRITE_JPEG_{name}"), value]
    return bytes(cv2.imencode(".jpg", image, parameters)[1])


def pixels(jpeg: bytes) -> Picture:
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_UNCHANGED)


def with_segment(jpeg: bytes, marker: int, body: bytes) -> bytes:
    """The file with one more segment right behind SOI."""
    return jpeg[:2] + bytes([0xFF, marker]) + (len(body) + 2).to_bytes(2, "big") + body + jpeg[2:]


def assert_same_picture(jpeg: bytes, rebuilt: bytes) -> None:
    np.testing.assert_array_equal(pixels(rebuilt), pixels(jpeg))


CODECS = [None, CodecId.IMAGE_JPEG, CodecId.IMAGE_FILE, CodecId.IMAGE_JPEG_CONTEXT]


@pytest.mark.parametrize("codec", CODECS)
def test_an_ordinary_jpeg_comes_back_as_a_baseline_file_of_the_same_pixels(codec: CodecId | None) -> None:
    jpeg = jpeg_of(picture())
    rebuilt = unpack_jpeg(pack_jpeg(jpeg, codec=codec))
    assert_same_picture(jpeg, rebuilt)
    assert rebuilt.count(b"\xff\xc0") == 1  # SOF0: baseline
    assert rebuilt.count(b"\xff\xc2") == 0  # SOF2: progressive


@pytest.mark.parametrize("codec", CODECS)
def test_a_file_with_standard_tables_comes_back_byte_for_byte(codec: CodecId | None) -> None:
    for seed in range(3):
        jpeg = jpeg_of(picture(97, 65, seed), 30 + 30 * seed, sampling="4:2:2")
        if len(pack_jpeg(jpeg)) < len(pack_jpeg(jpeg, codec=CodecId.IMAGE_JPEG)):
            assert unpack_jpeg(pack_jpeg(jpeg)) == jpeg


@pytest.mark.parametrize(
    ("codec", "savings"), [(CodecId.IMAGE_JPEG, (0.10, 0.10, 0.05)), (None, (0.25, 0.22, 0.22))]
)
def test_messages_are_smaller_by_as_much_as_documented(
    codec: CodecId | None, savings: tuple[float, ...]
) -> None:
    products = [(256, 136, 50), (200, 200, 70), (512, 272, 50)]
    for (width, height, quality), saving in zip(products, savings, strict=True):
        jpegs = [jpeg_of(picture(width, height, seed), quality) for seed in range(3)]
        packed = sum(len(pack_jpeg(jpeg, codec=codec)) for jpeg in jpegs)
        assert packed <= (1 - saving) * sum(map(len, jpegs))


@settings(max_examples=40)
@given(
    width=st.integers(1, 70),
    height=st.integers(1, 70),
    quality=st.integers(1, 100),
    sampling=st.sampled_from(sorted(SAMPLINGS)),
    grey=st.booleans(),
    wishes=st.sampled_from(
        [{}, {"OPTIMIZE": 1}, {"PROGRESSIVE": 1}, {"RST_INTERVAL": 1}, {"RST_INTERVAL": 7}]
    ),
    seed=st.integers(0, 1000),
    codec=st.sampled_from(CODECS),
)
def test_any_jpeg_keeps_its_pixels_and_never_grows(
    width: int,
    height: int,
    quality: int,
    sampling: str,
    grey: bool,
    wishes: dict[str, int],
    seed: int,
    codec: CodecId | None,
) -> None:
    jpeg = jpeg_of(picture(width, height, seed, grey), quality, sampling=sampling, **wishes)
    message = pack_jpeg(jpeg, codec=codec)
    assert len(message) <= len(jpeg) + 1
    assert_same_picture(jpeg, unpack_jpeg(message))


@pytest.mark.parametrize("quality", [1, 50, 100])
def test_noise_at_any_quality_keeps_its_pixels(quality: int) -> None:
    noise = np.random.default_rng(3).integers(0, 256, (41, 63, 3), dtype=np.uint8)
    jpeg = jpeg_of(noise, quality)
    assert_same_picture(jpeg, unpack_jpeg(pack_jpeg(jpeg)))


@pytest.mark.parametrize(
    ("marker", "body"),
    [
        (0xE1, b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"),
        (0xEE, b"Adobe\0d\0\0\0\0\0"),
        (0xFE, b"a comment"),
    ],
)
def test_metadata_that_changes_how_a_picture_is_shown_is_kept(marker: int, body: bytes) -> None:
    jpeg = with_segment(jpeg_of(picture()), marker, body)
    message = pack_jpeg(jpeg)
    rebuilt = unpack_jpeg(message)
    assert body in rebuilt
    assert len(message) < len(jpeg)
    assert_same_picture(jpeg, rebuilt)


def test_a_file_without_a_jfif_segment_stays_without_one() -> None:
    jpeg = jpeg_of(picture())
    bare = jpeg[:2] + jpeg[20:]
    rebuilt = unpack_jpeg(pack_jpeg(bare))
    assert b"JFIF" not in rebuilt
    assert_same_picture(bare, rebuilt)


def test_quantisation_tables_of_another_encoder_are_kept() -> None:
    jpeg = bytearray(jpeg_of(picture()))
    at = jpeg.index(b"\xff\xdb") + 5
    jpeg[at : at + 64] = bytes(range(3, 67))
    assert_same_picture(bytes(jpeg), unpack_jpeg(pack_jpeg(bytes(jpeg))))


def four_components() -> bytes:
    """Eight by eight pixels of CMYK, each of the four blocks a difference of 0 (00) and an end (1010)."""
    grey = jpeg_of(np.full((8, 8), 128, np.uint8))
    frame, scan = grey.index(b"\xff\xc0"), grey.index(b"\xff\xda")
    components = b"".join(bytes([number, 0x11, 0]) for number in range(1, 5))
    sof = b"\xff\xc0\x00\x14\x08\x00\x08\x00\x08\x04" + components
    sos = b"\xff\xda\x00\x0e\x04" + b"".join(bytes([number, 0]) for number in range(1, 5)) + b"\x00\x3f\x00"
    return grey[:frame] + sof + grey[frame + 13 : scan] + sos + bytes.fromhex("28a28a") + b"\xff\xd9"


def arithmetic_coded() -> bytes:
    """An arithmetic-coded frame: SOF9 and a DAC segment in place of Huffman's."""
    jpeg = jpeg_of(picture(64, 48))
    conditioning = b"\xff\xcc\x00\x06\x00\x10\x10\x05"
    at = jpeg.index(b"\xff\xda")
    return (jpeg[:at] + conditioning + jpeg[at:]).replace(b"\xff\xc0", b"\xff\xc9", 1)


@pytest.mark.parametrize("codec", [None, CodecId.IMAGE_JPEG, CodecId.IMAGE_JPEG_CONTEXT])
@pytest.mark.parametrize("make", [four_components, arithmetic_coded])
def test_a_kind_of_jpeg_that_is_not_modelled_travels_as_it_is(
    make: Callable[[], bytes], codec: CodecId | None
) -> None:
    jpeg = make()
    message = pack_jpeg(jpeg, codec=codec)
    assert message[0] == CodecId.IMAGE_FILE
    assert unpack_jpeg(message) == jpeg


@pytest.mark.parametrize(
    "damage",
    [
        lambda jpeg: jpeg[:-2],
        lambda jpeg: jpeg[: len(jpeg) // 2] + b"\xff\xd9",
        lambda jpeg: jpeg + b"behind the end",
        lambda jpeg: jpeg[:-2] + b"\0\xff\xd9",
        lambda jpeg: b"no JPEG",
        lambda jpeg: jpeg[:300],
    ],
)
def test_a_file_that_is_not_sound_travels_as_it_is(damage: object) -> None:
    jpeg = damage(jpeg_of(picture()))  # type: ignore[operator]
    assert unpack_jpeg(pack_jpeg(jpeg)) == jpeg


@settings(max_examples=60)
@given(place=st.integers(2, 3000), value=st.integers(0, 255))
def test_a_damaged_jpeg_never_comes_back_as_another_picture(place: int, value: int) -> None:
    jpeg = bytearray(jpeg_of(picture(96, 64, seed=4)))
    jpeg[place % len(jpeg)] = value
    try:
        shown = pixels(bytes(jpeg))
    except cv2.error:
        shown = None
    rebuilt = unpack_jpeg(pack_jpeg(bytes(jpeg)))
    if shown is not None:
        np.testing.assert_array_equal(pixels(rebuilt), shown)


def test_a_restart_marker_that_hides_a_large_step_of_brightness_does_no_harm() -> None:
    halves = np.zeros((16, 16), np.uint8)
    halves[:, 8:] = 255
    jpeg = jpeg_of(halves, 100, RST_INTERVAL=1)
    assert_same_picture(jpeg, unpack_jpeg(pack_jpeg(jpeg)))


@given(st.binary(max_size=300))
@example(b"")
@example(bytes([CodecId.IMAGE_JPEG]))
@example(bytes([CodecId.IMAGE_JPEG, 3, 50, 255, 255, 255, 255]))
@example(bytes([CodecId.IMAGE_JPEG, 7, 255, 255, 255]))
@example(bytes([CodecId.CLOUD_ZSTD, 0]))
def test_hostile_bytes_are_an_error_or_a_file(data: bytes) -> None:
    coded = bytes([CodecId.IMAGE_JPEG_CONTEXT, 3, 50, 40, 0, 24, 0]) + data
    for message in (data, bytes([CodecId.IMAGE_JPEG]) + data, coded):
        try:
            assert isinstance(unpack_jpeg(message), bytes)
        except DecodeError as error:
            assert str(error)


@settings(max_examples=100)
@given(data=st.data())
def test_a_damaged_message_is_an_error_or_a_baseline_file(data: st.DataObject) -> None:
    message = bytearray(pack_jpeg(jpeg_of(picture(96, 64, seed=4)), codec=CodecId.IMAGE_JPEG_CONTEXT))
    message[data.draw(st.integers(0, len(message) - 1))] = data.draw(st.integers(0, 255))
    for damaged in (bytes(message), bytes(message[: data.draw(st.integers(0, len(message)))])):
        try:
            assert isinstance(unpack_jpeg(damaged), bytes)
        except DecodeError as error:
            assert str(error)


def test_our_own_mistakes_are_said_in_a_sentence() -> None:
    with pytest.raises(EncodeError, match="0 bytes is outside"):
        pack_jpeg(b"")
    with pytest.raises(EncodeError, match="none of file, huffman, context"):
        pack_jpeg(jpeg_of(picture()), codec=CodecId.CLOUD_ZSTD)

"""Clouds come back within the error that their message declares."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray

from perception_server.view_codec import CodecId, DecodeError, EncodeError, decode_cloud, encode_cloud
from tests.perception_server.view_codec.clouds import room_cloud

CODECS: list[CodecId | None] = [None, CodecId.CLOUD_ZLIB, CodecId.CLOUD_ZSTD, CodecId.CLOUD_CONTEXT]
COORDINATE_M = st.floats(-1e3, 1e3, width=32)
CLOUD = arrays.arrays(np.float32, st.tuples(st.integers(0, 40), st.just(3)), elements=COORDINATE_M)


def distances_m(points: NDArray[np.float32], decoded: NDArray[np.float32]) -> NDArray[np.float64]:
    """From each point to the nearest decoded one."""
    apart = points.astype(np.float64)[:, None] - decoded.astype(np.float64)[None]
    return np.sqrt((apart**2).sum(axis=2)).min(axis=1)


@pytest.mark.parametrize("codec", CODECS)
@settings(max_examples=25)
@given(cloud=CLOUD, bits=st.integers(1, 20))
def test_every_point_is_within_the_reported_error(
    codec: CodecId | None, cloud: NDArray[np.float32], bits: int
) -> None:
    view = decode_cloud(encode_cloud(cloud, bits=bits, codec=codec))
    assert view.points.dtype == np.float32
    assert view.points.shape[1] == 3
    if len(cloud):
        assert distances_m(cloud, view.points).max() <= view.max_error_m * (1 + 1e-12)


@pytest.mark.parametrize("codec", CODECS)
@settings(max_examples=25)
@given(cloud=CLOUD, max_error_m=st.floats(0.001, 100))
def test_a_declared_error_is_kept_or_refused(
    codec: CodecId | None, cloud: NDArray[np.float32], max_error_m: float
) -> None:
    try:
        view = decode_cloud(encode_cloud(cloud, max_error_m=max_error_m, codec=codec))
    except EncodeError as error:
        assert "max_error_m" in str(error)
        return
    assert view.max_error_m <= max_error_m
    if len(cloud):
        assert distances_m(cloud, view.points).max() <= max_error_m


@pytest.mark.parametrize("codec", CODECS)
def test_fewer_bits_are_a_coarser_cloud(codec: CodecId | None) -> None:
    views = [decode_cloud(encode_cloud(room_cloud(), bits=bits, codec=codec)) for bits in (6, 8, 10)]
    steps = [view.step_m for view in views]
    assert steps[0] > 3.9 * steps[1] > 15 * steps[2]
    assert all(0.7 * view.step_m < view.max_error_m <= 0.867 * view.step_m for view in views)


def test_points_of_one_cell_become_one_and_no_other_is_added() -> None:
    cloud = np.repeat(room_cloud(500), 3, axis=0)
    view = decode_cloud(encode_cloud(cloud, max_error_m=0.001))
    assert len(np.unique(view.points, axis=0)) == len(view.points) == 500
    assert distances_m(view.points, cloud).max() <= 0.001


def test_the_papers_encoding_keeps_number_and_order_of_the_points() -> None:
    cloud = room_cloud(200)[::-1]
    view = decode_cloud(encode_cloud(cloud, bits=12, codec=CodecId.CLOUD_ZLIB))
    assert np.abs(view.points - cloud).max() <= view.step_m / 2 + 1e-6


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize(
    "cloud",
    [np.zeros((0, 3)), np.zeros((1, 3)), np.full((7, 3), 3.25), np.array([[1e30, -1e30, 0], [0, 0, 0]])],
)
@pytest.mark.parametrize("wish", [{"bits": 1}, {"bits": 10}, {"max_error_m": 1e28}])
def test_clouds_of_nothing_one_place_or_huge_size_work(
    codec: CodecId | None, cloud: NDArray[np.float64], wish: dict[str, float]
) -> None:
    view = decode_cloud(encode_cloud(cloud, **wish, codec=codec))  # type: ignore[arg-type]
    known = cloud.astype(np.float32)
    assert len(np.unique(view.points, axis=0)) == len(np.unique(known, axis=0))
    if len(cloud):
        assert distances_m(known, view.points).max() <= max(view.max_error_m, 1e23)


def voxels(seed: int = 0) -> NDArray[np.int64]:
    """(N, 3) voxels of 3 cm that hold a point of a room."""
    return np.unique(np.floor(room_cloud(1500, seed) / 0.03), axis=0).astype(np.int64)


@pytest.mark.parametrize("codec", ["zstd", "context"])
@pytest.mark.parametrize("wish", [{"bits": 8}, {"bits": 16}, {"max_error_m": 0.004}])
@pytest.mark.parametrize("offset_m", [(0.0, 0.0, 0.0), (-71.3, 12.77, 0.4)])
def test_centres_of_voxels_come_back_as_they_were_for_the_voxels_bytes(
    codec: str | None, wish: dict[str, float], offset_m: tuple[float, float, float]
) -> None:
    centres = ((voxels() + 0.5) * 0.03 + np.array(offset_m)).astype(np.float32)
    message = encode_cloud(centres, **wish, codec=codec)  # type: ignore[arg-type]
    view = decode_cloud(message)
    assert view.step_m == pytest.approx(0.03, rel=1e-5)
    assert distances_m(centres, view.points).max() <= view.max_error_m <= 4e-5
    assert len(view.points) == len(centres)
    least = encode_cloud(voxels().astype(float), max_error_m=0.5, codec=codec)
    assert len(message) == len(least)


@settings(max_examples=60)
@given(
    cells=arrays.arrays(np.int64, st.tuples(st.integers(2, 30), st.just(3)), elements=st.integers(-300, 300)),
    step_m=st.floats(0.005, 0.5),
    bits=st.integers(1, 20),
)
def test_a_lattice_of_any_step_is_no_worse_than_the_one_asked_for(
    cells: NDArray[np.int64], step_m: float, bits: int
) -> None:
    cloud = (cells * step_m).astype(np.float32)
    view = decode_cloud(encode_cloud(cloud, bits=bits, codec="zstd"))
    asked_m = decode_cloud(encode_cloud(cloud, bits=bits, codec="zlib"))
    assert view.max_error_m <= max(asked_m.max_error_m, 16 * np.spacing(np.abs(cloud).max()))
    assert view.step_m >= asked_m.step_m
    assert distances_m(cloud, view.points).max() <= view.max_error_m * (1 + 1e-12)


def test_points_without_a_place_are_left_out() -> None:
    cloud = room_cloud(300)
    holed = np.concatenate(
        [cloud, np.full((50, 3), np.nan, np.float32), [[np.inf, 0, 0], [0, -np.inf, np.nan]]]
    )
    assert encode_cloud(holed, bits=10) == encode_cloud(cloud, bits=10)


def test_the_same_cloud_in_any_order_gives_the_same_bytes() -> None:
    cloud = room_cloud(400)
    assert encode_cloud(cloud[::-1], bits=10) == encode_cloud(cloud, bits=10)


@pytest.mark.parametrize(
    ("cloud", "wish", "said"),
    [
        (room_cloud(10), {}, "exactly one"),
        (room_cloud(10), {"bits": 8, "max_error_m": 0.1}, "exactly one"),
        (room_cloud(10), {"bits": 0}, r"bits = 0 is outside 1\.\.20"),
        (room_cloud(10), {"max_error_m": 0.0}, "above 0"),
        (room_cloud(10), {"max_error_m": float("nan")}, "above 0"),
        (room_cloud(10), {"max_error_m": 1e-7}, "cannot be held"),
        (room_cloud(10) * np.array([1e6, 0, 0]), {"max_error_m": 1.0}, "more than 20 bits"),
        (np.array([[0, 0, 1e31]]), {"bits": 8}, "beyond 1e"),
        (np.zeros((4, 2)), {"bits": 8}, r"\(4, 2\) must be \(N, 3\)"),
        (room_cloud(10), {"bits": 8, "codec": CodecId.MAP_ZLIB}, "none of zlib, zstd, context"),
    ],
)
def test_what_cannot_be_held_is_refused_in_a_sentence(
    cloud: NDArray[np.float64], wish: dict[str, object], said: str
) -> None:
    with pytest.raises(EncodeError, match=said):
        encode_cloud(cloud, **wish)  # type: ignore[arg-type]


@settings(max_examples=150)
@given(codec=st.sampled_from([codec for codec in CODECS if codec]), data=st.binary(max_size=120))
@example(codec=CodecId.CLOUD_ZSTD, data=b"")
def test_hostile_bytes_are_an_error_or_a_cloud(codec: CodecId, data: bytes) -> None:
    lattice = encode_cloud(room_cloud(5), bits=8)[1:21]
    for message in (data, bytes([codec]) + data, bytes([codec]) + lattice + data):
        try:
            assert np.isfinite(decode_cloud(message).points).all()
        except DecodeError as error:
            assert str(error)


@pytest.mark.parametrize("codec", CODECS)
@settings(max_examples=40)
@given(data=st.data())
def test_a_damaged_message_is_an_error_or_a_cloud(codec: CodecId | None, data: st.DataObject) -> None:
    message = bytearray(encode_cloud(room_cloud(100), bits=8, codec=codec))
    message[data.draw(st.integers(0, len(message) - 1))] = data.draw(st.integers(0, 255))
    for damaged in (bytes(message), bytes(message[: data.draw(st.integers(0, len(message)))])):
        try:
            assert np.isfinite(decode_cloud(damaged).points).all()
        except DecodeError as error:
            assert str(error)


@pytest.mark.parametrize("codec", [CodecId.CLOUD_ZLIB, CodecId.CLOUD_ZSTD, CodecId.CLOUD_CONTEXT])
def test_a_small_message_that_stands_for_much_is_refused_early(codec: CodecId) -> None:
    message = bytearray(encode_cloud(np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]]), bits=8, codec=codec))
    message[21:26] = b"\x14\xff\xff\xff\xff" if codec is not CodecId.CLOUD_ZLIB else b"\x04\xff\xff\xff\xff"
    with pytest.raises(DecodeError, match="4294967295"):
        decode_cloud(bytes(message))


def test_the_small_codec_says_the_same_in_fewer_bytes_than_the_fast_one_and_the_papers() -> None:
    cloud = room_cloud(6000)
    messages = [encode_cloud(cloud, bits=8, codec=codec) for codec in CODECS[1:]]
    views = [np.unique(decode_cloud(message).points, axis=0) for message in messages]
    np.testing.assert_array_equal(views[0], views[1])
    np.testing.assert_array_equal(views[0], views[2])
    papers, fast, small = map(len, messages)
    assert 1.1 * small < fast < papers / 1.9

"""An octree's leaves hold every point and nothing else."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray

from perception_server.view_codec import CodecId, DecodeError, EncodeError, decode_octree, encode_octree
from perception_server.view_codec.occupancy import cells_of, codes_of
from tests.perception_server.view_codec.clouds import room_cloud

CODECS = [None, CodecId.OCTREE_ZSTD, CodecId.OCTREE_CONTEXT]
COORDINATE_M = st.floats(-1e3, 1e3, width=32)
CLOUD = arrays.arrays(np.float32, st.tuples(st.integers(0, 40), st.just(3)), elements=COORDINATE_M)


@pytest.mark.parametrize("codec", CODECS)
@settings(max_examples=25)
@given(cloud=CLOUD, leaf_m=st.floats(0.002, 500))
def test_the_leaves_are_those_that_hold_a_point(
    codec: CodecId | None, cloud: NDArray[np.float32], leaf_m: float
) -> None:
    view = decode_octree(encode_octree(cloud, leaf_m=leaf_m, codec=codec))
    assert view.leaf_m == leaf_m
    points = cloud.astype(np.float64)[:, None]
    inside = (view.keys * leaf_m <= points) & (points < (view.keys + 1) * leaf_m)
    holds = inside.all(axis=2)
    assert (holds.sum(axis=1) == 1).all()
    assert holds.any(axis=0).all()


@pytest.mark.parametrize("codec", CODECS)
def test_leaves_lie_on_a_grid_through_the_frames_origin(codec: CodecId | None) -> None:
    view = decode_octree(encode_octree(np.array([[0.01, -0.01, 0.26]]), leaf_m=0.05, codec=codec))
    np.testing.assert_array_equal(view.keys, [[0, -1, 5]])
    np.testing.assert_allclose(view.centres, [[0.025, -0.025, 0.275]], atol=1e-6)


def test_the_centres_of_leaves_give_the_same_leaves_again() -> None:
    message = encode_octree(room_cloud(), leaf_m=0.03)
    assert encode_octree(decode_octree(message).centres, leaf_m=0.03) == message


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize(
    "cloud", [np.zeros((0, 3)), np.zeros((1, 3)), np.full((9, 3), -7.5), np.full((2, 3), np.nan)]
)
def test_octrees_of_nothing_and_of_one_place_work(codec: CodecId | None, cloud: NDArray[np.float64]) -> None:
    view = decode_octree(encode_octree(cloud, leaf_m=0.1, codec=codec))
    assert len(view.keys) == len(np.unique(cloud[np.isfinite(cloud).all(axis=1)], axis=0))


@given(
    arrays.arrays(np.int64, st.tuples(st.integers(1, 50), st.just(3)), elements=st.integers(0, (1 << 20) - 1))
)
def test_codes_and_cells_are_the_same_set(cells: NDArray[np.int64]) -> None:
    back = cells_of(codes_of(cells))
    assert {tuple(cell) for cell in back.tolist()} == {tuple(cell) for cell in cells.tolist()}


@pytest.mark.parametrize(
    ("cloud", "leaf_m", "said"),
    [
        (room_cloud(10), 0.0, "leaf_m = 0.0"),
        (room_cloud(10), float("nan"), "leaf_m = nan"),
        (room_cloud(10), 1e-6, "along an axis"),
        (np.array([[1e12, 0.0, 0.0]]), 0.01, "leaves of 0.01 m away"),
        (np.zeros(3), 0.1, "must be"),
    ],
)
def test_what_cannot_be_held_is_refused_in_a_sentence(
    cloud: NDArray[np.float64], leaf_m: float, said: str
) -> None:
    with pytest.raises(EncodeError, match=said):
        encode_octree(cloud, leaf_m=leaf_m)


@settings(max_examples=100)
@given(codec=st.sampled_from([codec for codec in CODECS if codec]), data=st.binary(max_size=120))
def test_hostile_bytes_are_an_error_or_an_octree(codec: CodecId, data: bytes) -> None:
    grid = encode_octree(room_cloud(5), leaf_m=0.1)[1:21]
    for message in (data, bytes([codec]) + data, bytes([codec]) + grid + data):
        try:
            assert np.isfinite(decode_octree(message).centres).all()
        except DecodeError as error:
            assert str(error)

import contextlib

import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st

from shaper.compression import pack, unpack
from shaper.errors import DecodeError
from shaper.traffic_class import Compression

LIMIT = 100_000


@given(
    st.one_of(
        st.binary(max_size=500), st.builds(lambda b, n: b * n, st.binary(max_size=9), st.integers(0, 900))
    )
)
def test_a_payload_comes_back_and_never_grows(payload: bytes) -> None:
    data, compressed = pack(payload, Compression.ZSTD)
    assert len(data) <= len(payload)
    assert (unpack(data, LIMIT) if compressed else data) == payload


def test_repetitive_payloads_shrink_and_noise_stays_raw() -> None:
    assert pack(b"joint" * 1000, Compression.ZSTD)[1]
    assert len(pack(b"joint" * 1000, Compression.ZSTD)[0]) < 100
    noise = bytes((i * i * 7919 >> 3) & 0xFF for i in range(40))
    assert pack(noise, Compression.ZSTD) == (noise, False)


def test_raw_payloads_are_left_alone() -> None:
    assert pack(b"a" * 1000, Compression.RAW) == (b"a" * 1000, False)


def test_a_bomb_is_refused_before_it_is_unpacked() -> None:
    bomb = zstandard.ZstdCompressor(level=19).compress(bytes(50_000_000))
    assert len(bomb) < 10_000
    with pytest.raises(DecodeError, match=r"outside 0\.\.100000"):
        unpack(bomb, LIMIT)


def test_a_bomb_that_does_not_tell_its_size_is_refused() -> None:
    bomb = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(LIMIT + 1))
    with pytest.raises(DecodeError):
        unpack(bomb, LIMIT)


def test_a_bomb_that_understates_its_size_is_refused() -> None:
    honest = bytearray(zstandard.ZstdCompressor().compress(bytes(70_000)))
    at = bytes(honest).index((70_000).to_bytes(4, "little"))
    honest[at : at + 4] = (1000).to_bytes(4, "little")
    with pytest.raises(DecodeError, match="not zstd"):
        unpack(bytes(honest), LIMIT)


def test_exactly_the_limit_is_accepted() -> None:
    payload = bytes(LIMIT)
    assert unpack(pack(payload, Compression.ZSTD)[0], LIMIT) == payload


@given(st.binary(max_size=60))
def test_any_bytes_unpack_or_raise_a_decode_error(data: bytes) -> None:
    with contextlib.suppress(DecodeError):
        assert len(unpack(data, LIMIT)) <= LIMIT


@given(st.data())
def test_damaged_frames_unpack_or_raise_a_decode_error(data: st.DataObject) -> None:
    frame = bytearray(pack(b"straitlink " * 40, Compression.ZSTD)[0])
    for _ in range(data.draw(st.integers(1, 4))):
        frame[data.draw(st.integers(0, len(frame) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(DecodeError):
        assert len(unpack(bytes(frame), LIMIT)) <= LIMIT

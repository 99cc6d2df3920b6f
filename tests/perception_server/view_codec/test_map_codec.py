"""Maps as bytes: errors bounded, holes kept, any bytes survived."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from perception_server.view_codec import (
    CodecId,
    DecodeError,
    EncodeError,
    decode_map,
    encode_map,
    map_codec,
    warm_up,
)
from perception_server.view_codec.map_header import HEADER_BYTES, MAX_CELLS, MAX_CONTEXT_CELLS

GOLDEN = Path(__file__).parents[2] / "golden" / "view_maps.json"
CODECS = ("zlib", "serpentine", "context")
MapArray = NDArray[np.float32]


def terrain(rows: int, columns: int, seed: int = 1, noise_m: float = 0.008) -> MapArray:
    """Blocks on a slope, with a scanner's holes and noise."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:rows, :columns].astype(np.float64)
    heights = 0.01 * x - 0.9 + 0.2 * ((x // 13 + y // 9) % 2) + rng.normal(0, noise_m, (rows, columns))
    holes = (rng.random((rows, columns)) < 0.15) | ((x - columns / 2) ** 2 + (y - rows / 2) ** 2 < rows)
    return np.where(holes, np.nan, heights).astype(np.float32)


def kinect(rows: int, columns: int) -> MapArray:
    """A tilted wall and a box as a structured-light sensor gives them: whole disparities."""
    y, x = np.mgrid[:rows, :columns].astype(np.float64)
    disparity = np.round(200 + 0.7 * x + 0.3 * y + 60 * ((abs(x - 20) < 8) & (abs(y - 15) < 6)))
    return (570 / disparity).astype(np.float32)


MAPS = {
    "terrain": terrain(40, 60),
    "flat": np.full((9, 14), 1.25, np.float32),
    "holes alone": np.full((7, 5), np.nan, np.float32),
    "one cell": np.array([[2.5]], np.float32),
    "one cell in holes": np.where(np.arange(48).reshape(6, 8) == 29, 0.7, np.nan).astype(np.float32),
    "one row": terrain(1, 70),
    "one column": terrain(70, 1),
    "few values": np.where(np.arange(600).reshape(20, 30) % 7 < 3, 0.5, 3.0).astype(np.float32),
    "disparities": kinect(40, 50),
    "far apart": np.array([[-30.0, 30.0], [np.nan, 0.001]], np.float32),
}


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("name", MAPS)
def test_every_cell_comes_back_within_the_error_asked_for(name: str, codec: str) -> None:
    values = MAPS[name]
    for max_error_m in (0.01, 0.005, 0.001):
        view = decode_map(encode_map(values, max_error_m=max_error_m, codec=codec))
        np.testing.assert_array_equal(np.isnan(view.values), np.isnan(values))
        off = np.abs(view.values.astype(np.float64) - values)[~np.isnan(values)]
        assert off.max(initial=0.0) <= view.max_error_m <= max_error_m
        assert view.values.dtype == np.float32 and not view.altered


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("bits", (2, 8, 12))
def test_bits_divide_a_maps_own_range(bits: int, codec: str) -> None:
    values = MAPS["terrain"]
    view = decode_map(encode_map(values, bits=bits, codec=codec))
    span_m = float(np.nanmax(values) - np.nanmin(values))
    assert view.step_m == pytest.approx(span_m / (2**bits - 2), rel=1e-6)
    assert view.max_error_m <= view.step_m * 0.50001
    np.testing.assert_array_equal(np.isnan(view.values), np.isnan(values))


def test_all_codecs_decode_to_the_same_map() -> None:
    first, *others = (decode_map(encode_map(MAPS["terrain"], max_error_m=0.005, codec=c)) for c in CODECS)
    for other in others:
        np.testing.assert_array_equal(first.values, other.values)


def test_the_farthest_cell_is_no_hole_at_any_number_of_levels() -> None:
    for levels in (2, 254, 255, 256, 257, 300):
        values = np.linspace(0, (levels - 1) * 0.01, 320, dtype=np.float32).reshape(16, 20)
        for codec in CODECS:
            assert not np.isnan(decode_map(encode_map(values, max_error_m=0.005, codec=codec)).values).any()


def test_infinite_ranges_are_holes() -> None:
    values = np.array([[1.0, np.inf, -np.inf], [np.nan, 2.0, 3.0]], np.float32)
    view = decode_map(encode_map(values, bits=8))
    np.testing.assert_array_equal(np.isnan(view.values), ~np.isfinite(values))


def test_context_mixing_is_smaller_than_the_serpentine_than_zlib() -> None:
    zlib, serpentine, context = (
        len(encode_map(terrain(80, 120), max_error_m=0.005, codec=c)) for c in CODECS
    )
    assert context < 0.9 * serpentine < 0.9 * 0.95 * zlib


def test_unless_told_the_encoder_keeps_the_smaller_of_two() -> None:
    for values in (terrain(80, 120), kinect(80, 100), np.tile(MAPS["few values"], (5, 2))):
        sizes = [len(encode_map(values, max_error_m=0.005, codec=codec)) for codec in CODECS]
        assert len(encode_map(values, max_error_m=0.005)) == min(sizes[1:])


def test_a_palette_saves_where_a_sensor_measures_disparities() -> None:
    values = kinect(80, 100)
    jittered = values + np.random.default_rng(1).uniform(-5e-4, 5e-4, values.shape).astype(np.float32)
    sizes = [len(encode_map(m, max_error_m=0.0005)) for m in (values, jittered)]
    assert sizes[0] < 0.7 * sizes[1]


def test_denoising_is_told_and_lessens_the_error_to_the_truth() -> None:
    y, x = np.mgrid[:60, :80]
    truth = 0.01 * x - 0.005 * y + 0.3 * (x > 40)
    noisy = (truth + np.random.default_rng(2).normal(0, 0.008, truth.shape)).astype(np.float32)
    plain = decode_map(encode_map(noisy, max_error_m=0.005))
    smooth = decode_map(encode_map(noisy, max_error_m=0.005, denoise=True))
    assert smooth.altered and smooth.denoised and not plain.altered
    errors = [np.abs(view.values - truth) for view in (plain, smooth)]
    assert np.percentile(errors[1], 95) < 0.7 * np.percentile(errors[0], 95)
    assert np.abs(smooth.values - noisy).max() <= smooth.max_error_m + 1e-9


@pytest.mark.parametrize("height_m", [0.0, 0.0031, 0.0049, 0.0097, -0.0123])
def test_a_floor_lies_on_a_code_wherever_the_lowest_cell_is(height_m: float) -> None:
    rng = np.random.default_rng(4)
    values = rng.uniform(-1, 1, (60, 80)).astype(np.float32)
    floor = np.zeros(values.shape, np.bool_)
    floor[10:50, 10:70] = True
    values[floor] = height_m + rng.normal(0, 0.001, int(floor.sum()))
    view = decode_map(encode_map(values, max_error_m=0.01))
    assert abs(float(np.median((view.values - values)[floor]))) < 0.0015
    assert view.max_error_m <= 0.01


def test_an_overview_has_no_terraces() -> None:
    y, x = np.mgrid[:60, :80]
    truth = 0.0021 * x - 0.0013 * y
    noisy = (truth + np.random.default_rng(2).normal(0, 0.008, truth.shape)).astype(np.float32)
    view = decode_map(encode_map(noisy, max_error_m=0.01, denoise=True, close_gaps=True))
    off = np.abs(view.values - truth)
    assert np.percentile(off, 95) < 0.006 < 0.9 * view.step_m  # half a step, 10 mm, without smoothing


@pytest.mark.parametrize("codec", CODECS)
def test_closed_gaps_are_told_from_measurements(codec: str) -> None:
    values = np.full((5, 9), 1.0, np.float32)
    values[2, 3:5] = values[1:4, 7] = np.nan  # two cells across; three down, but one across
    values[:, 0] = np.nan  # at the border: no gap
    values[4, 5], values[4, 6], values[4, 7] = 1.0, np.nan, 2.0  # an edge: no gap
    view = decode_map(encode_map(values, max_error_m=0.001, codec=codec, close_gaps=True))
    expected = np.zeros(values.shape, bool)
    expected[2, 3:5] = expected[1:4, 7] = True
    expected[4, 6] = False
    np.testing.assert_array_equal(view.closed, expected)
    assert view.altered
    assert view.values[view.closed] == pytest.approx(1.0, abs=0.001)
    np.testing.assert_array_equal(np.isnan(view.values), np.isnan(values) & ~expected)


def test_closing_costs_no_bytes() -> None:
    values = terrain(40, 60)
    assert len(encode_map(values, bits=8, close_gaps=True)) == len(encode_map(values, bits=8))


@pytest.mark.parametrize(
    ("wish", "sentence"),
    [
        ({"max_error_m": 0.0}, "max_error_m = 0.0 must be above 0"),
        ({"max_error_m": 0.01, "bits": 8}, "give one of the two"),
        ({"max_error_m": 1e-6}, "the most is 65535"),
        ({"bits": 17}, "bits = 17 must be within 2..16"),
        ({"bits": 8.5}, "bits = 8.5 must be within 2..16"),
        ({"codec": "lerc"}, "codec = 'lerc' is none of"),
    ],
)
def test_a_wish_that_cannot_be_carried_is_a_sentence(wish: dict[str, object], sentence: str) -> None:
    with pytest.raises(EncodeError, match=sentence.replace(".", r"\.")):
        encode_map(MAPS["terrain"], **wish)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "values",
    [
        np.zeros(4, np.float32),
        np.zeros((2, 2), np.uint16),
        np.zeros((0, 3), np.float32),
        np.zeros((400, 400), np.float32),
    ],
)
def test_what_is_no_map_is_refused(values: MapArray) -> None:
    with pytest.raises(EncodeError, match="a map"):
        encode_map(values)


@pytest.mark.parametrize("kind", ["<f8", ">f8", ">f4", "<f2"])
def test_a_map_of_another_kind_of_float_keeps_the_error_to_its_own_numbers(kind: str) -> None:
    values = (np.random.default_rng(3).normal(0, 0.3, (30, 40)) + 60.0 * (kind[2] == "8")).astype(kind)
    view = decode_map(encode_map(values[::2, ::-1], max_error_m=0.00125))
    off_m = np.abs(values[::2, ::-1].astype(np.float64) - view.values).max()
    assert off_m <= view.max_error_m <= 0.00125


def test_a_large_map_takes_the_serpentine() -> None:
    values = np.zeros((300, 300), np.float32)
    assert encode_map(values, bits=8)[0] == 0x11
    with pytest.raises(EncodeError, match="90000 cells is too large"):
        encode_map(values, bits=8, codec="context")
    with pytest.raises(DecodeError, match="300 x 300 cells are more than 65536"):
        decode_map(b"\x12" + encode_map(values, bits=8)[1:])


def test_values_beyond_reason_are_refused_on_both_sides() -> None:
    with pytest.raises(EncodeError, match="within"):
        encode_map(np.array([[1.0, 2e9]], np.float32))
    message = bytearray(encode_map(MAPS["terrain"], bits=8))
    message[8:16] = np.array([0, 3e38], "<f4").tobytes()
    with pytest.raises(DecodeError, match="too far away"):
        decode_map(bytes(message))


def decoded_or_refused(data: bytes) -> None:
    try:
        view = decode_map(data)
    except DecodeError:
        return
    assert view.values.dtype == np.float32


@settings(max_examples=60)
@given(st.sampled_from(CODECS), st.sampled_from(sorted(MAPS)), st.data())
def test_damaged_maps_decode_or_are_refused(codec: str, name: str, data: st.DataObject) -> None:
    message = bytearray(encode_map(MAPS[name], max_error_m=0.005, codec=codec))
    for _ in range(data.draw(st.integers(1, 4))):
        message[data.draw(st.integers(0, len(message) - 1))] = data.draw(st.integers(0, 255))
    decoded_or_refused(bytes(message))


@settings(max_examples=60)
@given(
    st.sampled_from([0x10, 0x11, 0x12]),
    st.integers(0, 7),
    st.integers(1, 60),
    st.integers(1, 60),
    st.binary(max_size=80),
)
def test_any_bytes_decode_or_are_refused(
    codec: int, flags: int, rows: int, columns: int, rest: bytes
) -> None:
    decoded_or_refused(bytes([codec, flags, rows, 0, columns, 0]) + rest)


@pytest.mark.parametrize("codec", CODECS)
def test_cut_and_lengthened_maps_are_refused(codec: str) -> None:
    message = encode_map(MAPS["terrain"], max_error_m=0.005, codec=codec)
    for broken in (b"", message[:7], message[: len(message) // 2], message + b"more"):
        with pytest.raises(DecodeError):
            decode_map(broken)


def golden_map() -> MapArray:
    """Heights made with whole numbers, so that every machine has the same."""
    cells = np.arange(24 * 30, dtype=np.int64)
    x, y = cells % 30, cells // 30
    heights = (x * 3 + y * y // 2 + 40 * (x // 8 % 2) + cells * cells * 7 % 5).astype(
        np.float32
    ) / np.float32(16)
    heights[(cells * cells + x) % 6 == 0] = np.nan
    return heights.reshape(24, 30)


@pytest.mark.parametrize("codec", CODECS)
def test_messages_of_today_decode_for_ever(codec: str) -> None:
    view = decode_map(bytes.fromhex(json.loads(GOLDEN.read_text())[codec]))
    np.testing.assert_allclose(view.values, golden_map(), atol=0.03125, rtol=0)


def test_context_mixing_writes_the_same_bytes_everywhere() -> None:
    message = encode_map(golden_map(), max_error_m=0.03125, codec="context")
    assert message.hex() == json.loads(GOLDEN.read_text())["context"]


def test_the_warm_up_knows_its_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    warm_up()
    monkeypatch.setattr(map_codec, "_WARM_UP_CRC", 1)
    with pytest.raises(RuntimeError, match="not 0x00000001: remove"):
        warm_up()


def test_the_document_has_the_headers_numbers() -> None:
    text = (Path(__file__).parents[3] / "docs" / "view_codecs.md").read_text()
    for told in (
        f"Header, {HEADER_BYTES} bytes",
        f"{MAX_CELLS:,} cells",
        f"context mixing {MAX_CONTEXT_CELLS:,}",
    ):
        assert told in text
    for codec in (CodecId.MAP_ZLIB, CodecId.MAP_SERPENTINE, CodecId.MAP_CONTEXT):
        assert f"### 0x{codec:02x} " in text


FALLBACK = """
import sys
sys.modules["numba"] = None
import numpy as np
from perception_server.view_codec import decode_map, encode_map
from tests.perception_server.view_codec import test_map_codec as maps
from perception_server.view_codec.compiled import IS_COMPILED
assert not IS_COMPILED
for name in ("terrain", "disparities", "one row", "flat", "holes alone"):
    message = encode_map(maps.MAPS[name][:24], max_error_m=0.002, codec="context")
    assert decode_map(message).values.shape == maps.MAPS[name][:24].shape
    print(message.hex())
print(encode_map(maps.MAPS['terrain'], bits=8)[0])
"""


def test_without_numba_the_bytes_are_the_same_and_the_serpentine_is_the_default() -> None:
    run = subprocess.run([sys.executable, "-c", FALLBACK], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    *messages, default = run.stdout.split()
    for name, message in zip(
        ("terrain", "disparities", "one row", "flat", "holes alone"), messages, strict=True
    ):
        assert encode_map(MAPS[name][:24], max_error_m=0.002, codec="context").hex() == message
    assert int(default) == 0x11

"""Overviews: small, in proportion, and never an exception of somebody else's."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from perception_server.overview import Overview, ViewError, render_overview


def picture(columns: int, rows: int, suffix: str = ".jpg") -> bytes:
    x, y = np.meshgrid(np.linspace(0, 255, columns), np.linspace(0, 255, rows))
    colours = np.dstack([x, y, 255 - x]).astype(np.uint8)
    return bytes(cv2.imencode(suffix, colours)[1])


def decode(jpeg: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)


def test_an_overview_shows_the_same_colours_in_fewer_pixels() -> None:
    small = decode(render_overview(picture(1024, 544), Overview()))
    assert small.shape == (136, 256, 3)
    expected = cv2.resize(decode(picture(1024, 544)), (256, 136), interpolation=cv2.INTER_AREA)
    assert np.abs(small.astype(int) - expected).mean() < 4


@pytest.mark.parametrize(
    ("columns", "rows", "shape"), [(640, 480, (136, 181)), (100, 50, (50, 100)), (4000, 20, (1, 256))]
)
def test_proportions_are_kept_and_nothing_is_enlarged(
    columns: int, rows: int, shape: tuple[int, int]
) -> None:
    assert decode(render_overview(picture(columns, rows), Overview())).shape[:2] == shape


def test_a_png_will_do() -> None:
    assert decode(render_overview(picture(512, 272, ".png"), Overview())).shape == (136, 256, 3)


@given(st.binary(max_size=400))
def test_any_bytes_give_a_picture_or_a_view_error(data: bytes) -> None:
    try:
        jpeg = render_overview(data, Overview())
    except ViewError:
        return
    assert decode(jpeg) is not None


@pytest.mark.parametrize(("field", "value"), [("width_px", 0), ("height_px", 9000), ("quality", 101)])
def test_a_size_that_cannot_be_is_refused_by_name(field: str, value: int) -> None:
    with pytest.raises(ViewError, match=f"{field} = {value}"):
        Overview(**{field: value})

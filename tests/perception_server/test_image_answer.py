"""Which camera and which frame an image request means."""

from __future__ import annotations

import pytest

from messages.proto.straitlink.view_pb2 import (
    VIEW_STATUS_NO_DATA,
    VIEW_STATUS_REFUSED,
    VIEW_STATUS_RENDERED,
    Image,
    ImageRequest,
)
from perception_server.history import HistorySnapshot
from perception_server.image_answer import answer_image
from perception_server.pictures import Calibration
from straitlink.synthetic.camera import Pinhole
from tests.perception_server.camera_frames import CHEST_FOV_RAD, S, chest_frame, head_frame

MATRIX = tuple(Pinhole(640, 480, 640 / CHEST_FOV_RAD).matrix.ravel().tolist())
CHEST = Calibration("chest_camera_optical_frame", 640, 480, "kannala_brandt", (0.0,) * 4, MATRIX, (), ())
HISTORY = HistorySnapshot(
    cameras={"head": (head_frame(0), head_frame(1), head_frame(2)), "chest": (chest_frame(),)},
    calibrations={CHEST.frame_id: CHEST},
)


def ask(history: HistorySnapshot = HISTORY, budget_bytes: int = 100_000, **said: object) -> Image:
    return answer_image(ImageRequest(request_id=3, **said), history, budget_bytes)  # type: ignore[arg-type]


def test_the_newest_frame_of_the_camera_named_by_preset_or_source_is_shown() -> None:
    assert ask(preset="head_low").frame_ns == head_frame(2).capture_ns
    assert ask(preset="chest").source == "chest"
    assert ask(preset="chip", source="chest").source == "chest"


def test_a_frame_at_a_time_is_the_nearest_one() -> None:
    assert ask(source="head", at_ns=101 * S + 4).frame_ns == head_frame(1).capture_ns


def test_a_time_that_nothing_is_kept_of_is_told() -> None:
    missing = ask(source="head", at_ns=90 * S)
    assert missing.status == VIEW_STATUS_NO_DATA
    assert missing.error == f"at_ns = {90 * S}: the nearest frame kept is +10.0 s from it"


def test_a_camera_must_be_named_where_there_are_several() -> None:
    missing = ask(preset="chip")
    assert missing.status == VIEW_STATUS_REFUSED
    assert missing.error == "source: is missing: must be one of chest, head"
    only = HistorySnapshot(cameras={"head": (head_frame(),)})
    assert ask(only, preset="chip").status == VIEW_STATUS_RENDERED


def test_an_unknown_camera_is_refused_and_none_at_all_is_no_data() -> None:
    assert ask(source="tail").error == "source = 'tail': must be one of chest, head"
    assert ask(HistorySnapshot(), source="tail").status == VIEW_STATUS_NO_DATA
    assert ask(HistorySnapshot()).status == VIEW_STATUS_NO_DATA


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"quality": 500}, "quality = 500"),
        ({"chips": [{"x_px": 1000, "width_px": 90, "height_px": 9}]}, "chips[0]"),
    ],
)
def test_what_a_request_says_wrongly_comes_back_by_field(change: dict[str, object], named: str) -> None:
    refused = ask(preset="head_low", **change)
    assert refused.status == VIEW_STATUS_REFUSED and refused.error.startswith(named)
    assert refused.request_id == 3


def test_a_straight_view_needs_a_calibration_that_is_sound() -> None:
    without = HistorySnapshot(cameras=HISTORY.cameras)
    assert ask(without, preset="chest").error.startswith("horizontal_fov_rad = 1.1: chest has no calibration")
    broken = Calibration(CHEST.frame_id, 640, 480, "thin_prism", (), MATRIX, (), ())
    told = ask(
        HistorySnapshot(cameras=HISTORY.cameras, calibrations={CHEST.frame_id: broken}), preset="chest"
    )
    assert told.status == VIEW_STATUS_NO_DATA and "distortion_model = 'thin_prism'" in told.error


def test_budgets_are_kept() -> None:
    assert ask(preset="head_high", budget_bytes=4_000).ByteSize() <= 4_000
    assert ask(preset="head_high", budget_bytes=50).error.startswith("does not fit: smallest is")

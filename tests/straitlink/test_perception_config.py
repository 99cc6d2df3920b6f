"""The perception server's file, and requests as they are typed."""

from __future__ import annotations

from pathlib import Path

import pytest

from messages.proto.straitlink.view_pb2 import ImageRequest, ViewRequest
from perception_server.errors import RequestError
from perception_server.history import HistoryLimits
from shaper.errors import ConfigError
from straitlink.perception_config import load_perception_config
from straitlink.request_words import request_of

ROOT = Path(__file__).resolve().parents[2]
SMALLEST = """
[zenoh]
connect = ["tcp/127.0.0.1:7447"]
[inputs.head]
key = "robot/head_camera/image"
"""


def load(tmp_path: Path, text: str) -> object:
    path = tmp_path / "perception.toml"
    path.write_text(text)
    return load_perception_config(path)


def test_the_example_is_read() -> None:
    config = load_perception_config(ROOT / "examples" / "perception.toml")
    by_key = {stream.key: stream for stream in config.streams}
    overview = by_key["robot/head_camera/overview"]
    assert overview.period_ns == 1_000_000_000 and isinstance(overview.request, ImageRequest)
    assert overview.key in config.foxglove_keys
    assert {each.name for each in config.inputs} >= {"head", "chest"}


def test_what_is_not_said_has_the_core_s_defaults(tmp_path: Path) -> None:
    path = tmp_path / "perception.toml"
    path.write_text(SMALLEST)
    config = load_perception_config(path)
    assert config.limits == HistoryLimits()
    assert config.streams == () and config.server.prefix == "robot/view"


@pytest.mark.parametrize(
    ("added", "told"),
    [
        ("[history]\nduration_s = 0", "history.duration_s = 0: input should be greater than or equal to 1"),
        ("[history]\nscans = 3", "history.scans = 3: unknown key; expected one of duration_s"),
        ("[inputs.tail]\nkey = 'robot/*'", 'inputs.tail.key = "robot/*": expected a Zenoh key without'),
        (
            "[[frames.self_boxes]]\nframe = 'torso'\nlow_m = [0, 0, 0]\nhigh_m = [1, 1, 1]\nname = 'x'",
            'frames.self_boxes[0].name = "x": unknown key; expected one of frame, low_m, high_m',
        ),
        ("[views.a]\nkind = 'video'\nrequest = {}", 'views.a.kind = "video": '),
        ("[views.a]\nkind = 'image'", "views.a.request: is missing"),
        ("[views.a]\nkind = 'image'\nrequest = { quality = 101 }", "views.a.request.quality = 101: must be"),
        (
            "[views.a]\nkind = 'image'\nrequest = { qual = 1 }",
            "views.a.request.qual: unknown; must be one of",
        ),
        ("[views.a]\nkind = 'image'\nrequest = { source = 'tail' }", "views.a.request.source = 'tail': must"),
        (
            "[views.a]\nkind = 'image'\nrequest = { period_ms = 5 }",
            "views.a.request.period_ms = 5: a standing",
        ),
        (
            "[views.a]\nkind = 'geometry'\nform = 'foxglove'\nrequest = { preset = 'height_map_scene' }",
            'views.a.form = "foxglove"',
        ),
        ("[views.requested]\nkind = 'image'\nrequest = {}", "views.requested: its key"),
        ("[views.'a b*']\nkind = 'image'\nrequest = {}", "views.a b*: 'robot/view/a b*' is no key"),
    ],
)
def test_a_mistake_is_told_with_file_field_and_value(tmp_path: Path, added: str, told: str) -> None:
    with pytest.raises(ConfigError) as refused:
        load(tmp_path, SMALLEST + added)
    assert str(refused.value).startswith(f"{tmp_path / 'perception.toml'}: {told}")


def test_a_request_is_typed_as_a_preset_and_fields() -> None:
    assert request_of(["head_low"]) == ImageRequest(preset="head_low")
    assert request_of(["image", "head_low", "quality=40"]) == ImageRequest(preset="head_low", quality=40)
    chips = request_of(["chip", "chips=1,2,30,40+5,6,70,80"])
    assert isinstance(chips, ImageRequest)
    assert [(c.x_px, c.y_px, c.width_px, c.height_px) for c in chips.chips] == [
        (1, 2, 30, 40),
        (5, 6, 70, 80),
    ]
    assert isinstance(request_of(["height_map_scene"]), ViewRequest)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["head_low", "head_high"], "'head_high': expected field=value"),
        (["head_low", "quality=0"], "quality = 0: must be within 1..100"),
        (["chip", "chips=1,2"], "chips = '1,2': expected x,y,width,height"),
        (["head_low", "period_ms=500"], "period_ms = 500: one view is requested"),
        (["tail_low"], "preset = 'tail_low': must be one of head_low, head_high, chest"),
        (["image", "tail_low"], "preset = 'tail_low': must be one of head_low"),
    ],
)
def test_a_request_typed_wrongly_is_told_by_field(words: list[str], told: str) -> None:
    with pytest.raises(RequestError) as refused:
        request_of(words)
    assert str(refused.value).startswith(told)

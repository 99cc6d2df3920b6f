"""The synthetic mission's log: reproducible, as heavy as the paper's, readable by anybody's tools."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import Message
from mcap.reader import make_reader

from messages.catalogue import CATALOGUE, find_topic
from straitlink.synthetic import (
    SyntheticMessage,
    SyntheticSettings,
    SyntheticSummary,
    message_stream,
    synthesize,
)
from straitlink.synthetic.joints import JOINT_NAMES, LOWER_RAD, UPPER_RAD, VELOCITY_RADPS
from straitlink.synthetic.lidar import Scanner
from straitlink.synthetic.scene import build_scene
from straitlink.synthetic.settings import START_NS, TEXTURES

LIGHT = SyntheticSettings(duration_s=2.0, light=True)


@pytest.fixture(scope="module")
def light_log(tmp_path_factory: pytest.TempPathFactory) -> SyntheticSummary:
    return synthesize(tmp_path_factory.mktemp("light") / "mission.mcap", LIGHT)


@pytest.fixture(scope="module")
def full_second() -> list[SyntheticMessage]:
    return list(message_stream(SyntheticSettings(duration_s=1.0)))


@pytest.mark.parametrize("settings", [LIGHT, SyntheticSettings(duration_s=1.0)], ids=["light", "full"])
def test_equal_settings_give_equal_bytes_also_in_another_process(
    tmp_path: Path, settings: SyntheticSettings
) -> None:
    script = (
        "import sys; from pathlib import Path; from straitlink.synthetic import *;"
        f"synthesize(Path(sys.argv[1]), {settings!r})"
    )
    ours, other = synthesize(tmp_path / "ours.mcap", settings).path, tmp_path / "other.mcap"
    subprocess.run([sys.executable, "-c", script, str(other)], check=True, cwd=Path(__file__).parents[2])
    digests = {hashlib.sha256(path.read_bytes()).hexdigest() for path in (ours, other)}
    assert len(digests) == 1


def test_another_seed_gives_other_bytes(tmp_path: Path) -> None:
    short = [SyntheticSettings(duration_s=0.3, light=True, seed=seed) for seed in (1, 2)]
    logs = [synthesize(tmp_path / f"{settings.seed}.mcap", settings).path for settings in short]
    assert logs[0].read_bytes() != logs[1].read_bytes()


def test_a_full_log_carries_what_the_paper_says(full_second: list[SyntheticMessage]) -> None:
    total_bytes = sum(len(message.payload) for message in full_second)
    assert len(full_second) == pytest.approx(4000, rel=0.1)
    assert total_bytes == pytest.approx(5e6, rel=0.1)


def test_every_topic_comes_at_its_rate(full_second: list[SyntheticMessage]) -> None:
    counts = Counter(message.key for message in full_second)
    for topic in CATALOGUE:
        if topic.rate_hz >= 1:
            assert abs(counts[topic.key] - topic.rate_hz) <= 1, topic.key


def test_samples_come_in_order_of_time_and_are_numbered(full_second: list[SyntheticMessage]) -> None:
    stamps = [message.capture_ns for message in full_second]
    assert stamps == sorted(stamps)
    assert stamps[0] >= START_NS and stamps[-1] < START_NS + 1_000_000_000
    numbers: dict[str, int] = {}
    for message in full_second:
        assert message.sequence == numbers.get(message.key, 0)
        numbers[message.key] = message.sequence + 1


def test_a_light_log_has_no_topic_above_50_hz(light_log: SyntheticSummary) -> None:
    for topic in light_log.topics:
        assert topic.messages <= 50 * LIGHT.duration_s, topic.key


def test_joint_states_with_noise_keep_within_the_limits(full_second: list[SyntheticMessage]) -> None:
    for message in full_second:
        if message.key in ("robot/joint_states", "robot/joint_commands"):
            joints = decode(message).joints  # type: ignore[attr-defined]
            assert tuple(joint.name for joint in joints) == JOINT_NAMES
            positions = np.array([joint.position for joint in joints])
            assert ((positions >= LOWER_RAD) & (positions <= UPPER_RAD)).all()
            assert (np.abs([joint.velocity for joint in joints]) <= VELOCITY_RADPS).all()


def test_every_heartbeat_has_64_bytes(full_second: list[SyntheticMessage]) -> None:
    sizes = {len(message.payload) for message in full_second if message.key.endswith("/heartbeat")}
    assert sizes == {64}


def test_scans_drop_one_beam_in_a_hundred_and_use_the_codes_of_rep_117() -> None:
    scanner = Scanner(build_scene(1), seed=1)
    lost = echoes = errors = 0
    residuals: list[np.ndarray[tuple[int], np.dtype[np.float64]]] = []
    for index in range(120):
        truth, _ = scanner.true_ranges(index * 0.5)
        ranges = scanner.scan(index * 0.5).ranges_m
        assert np.isneginf(ranges[[0, 1, 2, 3, -4, -3, -2, -1]]).all()
        inside = slice(8, -8)
        seen = np.isfinite(truth[inside]) & (truth[inside] < 9.9)
        measured = ranges[inside][seen]
        lost += int(np.isposinf(measured).sum())
        errors += int(np.isnan(measured).sum())
        echoes += int(seen.sum())
        assert np.isposinf(ranges[inside][np.isinf(truth[inside])]).mean() > 0.98
        residuals.append((measured - truth[inside][seen])[np.isfinite(measured)])
    assert lost / echoes == pytest.approx(0.01, abs=0.002)
    assert errors / echoes == pytest.approx(0.001, abs=0.0005)
    noise = np.concatenate(residuals)
    assert noise.std() == pytest.approx(0.010, rel=0.03)
    assert abs(noise.mean()) < 0.0003


def test_a_light_log_opens_with_mcap_and_decodes_with_the_schemas_it_carries(
    light_log: SyntheticSummary,
) -> None:
    with light_log.path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == light_log.messages
        assert {channel.message_encoding for channel in summary.channels.values()} == {"protobuf"}
        seen = set()
        for schema, channel, message in reader.iter_messages():
            assert message.log_time == message.publish_time
            topic = find_topic(channel.topic.removeprefix("/"))
            assert topic is not None and schema is not None and schema.name == topic.schema_name
            if channel.topic not in seen:
                seen.add(channel.topic)
                by_log = embedded_class(schema.data, schema.name).FromString(message.data)
                by_class = topic.message_type.FromString(message.data)
                assert by_log.SerializeToString() == by_class.SerializeToString() == message.data
        assert len(seen) >= len(CATALOGUE) - 3


def test_the_log_holds_its_ground_truth_and_its_parameters(light_log: SyntheticSummary) -> None:
    with light_log.path.open("rb") as file:
        reader = make_reader(file)
        attachments, metadata = list(reader.iter_attachments()), list(reader.iter_metadata())
    assert [attachment.name for attachment in attachments] == ["ground_truth.json"]
    truth = json.loads(attachments[0].data)
    assert len(truth["boxes"]) == len(build_scene(1))
    assert {box["kind"] for box in truth["boxes"]} == {"floor", "wall", "block", "debris", "valve"}
    assert metadata[0].name == "straitlink.synthetic"
    assert metadata[0].metadata["seed"] == "1"


def test_camera_frames_are_pictures_of_the_stated_size(light_log: SyntheticSummary) -> None:
    sizes = {}
    with light_log.path.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(
            topics=["/robot/head_camera/image", "/robot/chest_camera/image"]
        ):
            topic = find_topic(channel.topic.removeprefix("/"))
            assert topic is not None
            image = topic.message_type.FromString(message.data)
            pixels = np.frombuffer(image.data, np.uint8)  # type: ignore[attr-defined]
            picture = cv2.imdecode(pixels, cv2.IMREAD_COLOR)
            assert picture is not None
            sizes[channel.topic] = picture.shape
            assert picture.std() > 20
    assert sizes == {"/robot/head_camera/image": (170, 320, 3), "/robot/chest_camera/image": (120, 160, 3)}


def test_the_indoor_textures_cost_about_half_of_the_busy_ones() -> None:
    mean_bytes = {}
    for texture in TEXTURES:
        settings = SyntheticSettings(duration_s=0.3, texture=texture)
        topic = find_topic("robot/head_camera/image")
        assert topic is not None
        sizes = [len(message.payload) for message in message_stream(settings) if message.key == topic.key]
        mean_bytes[texture] = sum(sizes) / len(sizes)
    assert mean_bytes["busy"] / (1024 * 544) == pytest.approx(0.24, abs=0.04)
    assert mean_bytes["indoor"] / (1024 * 544) == pytest.approx(0.115, abs=0.03)


def test_progress_rises_to_one(tmp_path: Path) -> None:
    shares: list[float] = []
    synthesize(tmp_path / "log.mcap", SyntheticSettings(duration_s=1.0, light=True), shares.append)
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert len(shares) >= 4


@pytest.mark.parametrize(
    ("field", "value", "bound"),
    [("duration_s", 0.0, "above 0"), ("seed", -1, "0..2"), ("texture", "plaid", "busy, indoor")],
)
def test_a_wrong_setting_is_refused_with_its_bound(field: str, value: object, bound: str) -> None:
    with pytest.raises(ValueError, match=field) as refused:
        SyntheticSettings(**{field: value})  # type: ignore[arg-type]
    assert bound in str(refused.value)


def decode(message: SyntheticMessage) -> object:
    topic = find_topic(message.key)
    assert topic is not None
    return topic.message_type.FromString(message.payload)


def embedded_class(file_descriptor_set: bytes, name: str) -> type[Message]:
    """The message class as an outsider builds it from the log's schema alone."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(file_descriptor_set).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))

"""What a replay selects, claims and refuses; the bus itself is in tests/live/."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.records import Channel, Message, Schema
from mcap.summary import Summary
from mcap.writer import Writer

from shaper.bus import BusSettings
from straitlink import replay as replay_module
from straitlink.replay import ReplaySettings, replay
from straitlink.replay_log import ReplayError, channel_encoding, topic_key
from straitlink.replay_timing import Lateness, Pass

S = 1_000_000_000
WALL_NS = 1_800_000_000 * S


def write_log(path: Path, topics: tuple[str, ...] = ("/a", "/b")) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for number, topic in enumerate(topics):
            writer.add_message(writer.register_channel(topic, "json", 0), (10 + number) * S, b"{}", 10 * S)
        writer.finish()
    return path


def settings(log: Path = Path("log.mcap"), **changes: Any) -> ReplaySettings:
    return ReplaySettings(log, BusSettings(), **changes)


def message(log_s: float, publish_s: float) -> Message:
    return Message(1, round(log_s * S), b"", round(publish_s * S), 0)


def summary_of(*topics: str) -> Summary:
    summary = Summary()
    for number, topic in enumerate(topics, start=1):
        summary.channels[number] = Channel(number, topic, "json", {}, 0)
    return summary


def selected(topics: tuple[str, ...], **changes: Any) -> set[str]:
    channels = replay_module._selected(summary_of(*topics), settings(**changes))
    return {channel.topic for channel in channels.values()}


def captures(messages: list[Message], **changes: Any) -> list[int]:
    asked = settings(**changes)
    current = Pass(asked.rate, asked.stamp, 10 * S, 0, WALL_NS)
    return [current.capture_ns(m, current.offset_ns(m.log_time)) for m in messages]


@pytest.mark.parametrize(
    ("topic", "key"), [("/robot/scan", "robot/scan"), ("imu", "imu"), ("/a/@b/", "a/@b")]
)
def test_a_topic_is_a_key_without_the_slash(topic: str, key: str) -> None:
    assert topic_key(topic) == key


@pytest.mark.parametrize("topic", ["/", "", "/a//b", "/a/*", "/a#b", "/a?", "/$x"])
def test_a_topic_that_zenoh_would_refuse_is_named(topic: str) -> None:
    with pytest.raises(ReplayError, match="cannot be a Zenoh key"):
        topic_key(topic)


def test_topics_are_taken_by_name_or_key_expression_and_left_out_likewise() -> None:
    topics = ("/camera/left", "/camera/right", "/imu", "/cmd")
    assert selected(topics) == set(topics)
    assert selected(topics, include=("camera/**", "/imu")) == {"/camera/left", "/camera/right", "/imu"}
    assert selected(topics, include=("/camera/*",), exclude=("camera/left",)) == {"/camera/right"}
    assert selected(topics, exclude=("**/left", "/cmd")) == {"/camera/right", "/imu"}


def test_a_topic_that_cannot_be_a_key_may_be_excluded_by_its_name() -> None:
    assert selected(("/odd#topic", "/imu"), exclude=("/odd#topic",)) == {"/imu"}


def test_a_selection_of_nothing_lists_what_the_log_has() -> None:
    with pytest.raises(ReplayError, match="it has /a, /b"):
        selected(("/a", "/b"), include=("/c",))


def test_the_first_message_is_captured_now_and_differences_stay() -> None:
    assert captures([message(10, 10), message(12.5, 12.5)]) == [WALL_NS, WALL_NS + round(2.5 * S)]


def test_a_message_keeps_the_age_that_it_had_when_logged() -> None:
    first, late = captures([message(10, 10), message(11, 10.4)])
    assert (first, late) == (WALL_NS, WALL_NS + round(0.4 * S))


def test_another_clocks_capture_times_count_from_the_first_message() -> None:
    first, second = captures([message(10, 5_000), message(11, 5_000.9)])
    assert (first, second) == (WALL_NS, WALL_NS + round(0.9 * S))


def test_absent_capture_times_become_the_first_messages_and_not_the_epoch() -> None:
    assert captures([message(1e6, 0)], start_s=0.0)[0] == WALL_NS + (10**6 - 10) * S


def test_at_double_rate_capture_times_follow_the_puts() -> None:
    assert captures([message(10, 10), message(14, 13.9)], rate=2.0) == [WALL_NS, WALL_NS + round(1.9 * S)]


def test_the_logs_own_stamps_stay_on_request() -> None:
    assert captures([message(10, 10), message(11, 10.4)], stamp="log") == [10 * S, round(10.4 * S)]


@given(st.lists(st.integers(0, 10**12), min_size=2), st.integers(0, 10**10))
def test_at_rate_one_every_difference_between_captures_is_exact(publish: list[int], latency_ns: int) -> None:
    messages = [Message(1, p + latency_ns, b"", p, 0) for p in publish]
    shifts = {c - m.publish_time for c, m in zip(captures(messages), messages, strict=True)}
    assert len(shifts) == 1


def test_the_log_numbers_its_messages_and_a_second_pass_counts_on() -> None:
    outlet = replay_module._Outlet(None, "/a")  # type: ignore[arg-type]
    assert [outlet.next_sequence(n, first_pass=True) for n in (40, 41, 43)] == [40, 41, 43]
    assert [outlet.next_sequence(n, first_pass=False) for n in (40, 41)] == [44, 45]


def test_a_log_that_does_not_count_is_counted() -> None:
    outlet = replay_module._Outlet(None, "/a")  # type: ignore[arg-type]
    assert [outlet.next_sequence(0, first_pass=True) for _ in range(3)] == [0, 1, 2]


def test_lateness_quantiles_are_exact_to_their_bin_and_the_maximum_exactly() -> None:
    lateness = Lateness()
    for milliseconds in range(100):
        lateness.add(milliseconds * 1_000_000)
    assert lateness.quantile_ms(0.5) == pytest.approx(49.1)
    assert lateness.quantile_ms(0.95) == pytest.approx(94.1)
    lateness.add(7 * S)
    assert (lateness.quantile_ms(1.0), lateness.max_ns) == (7000.0, 7 * S)


def test_an_encoding_names_the_channels_schema_or_what_the_recorder_noted() -> None:
    summary = Summary()
    summary.schemas[3] = Schema(3, b"", "ros2msg", "sensor_msgs/msg/Imu")
    assert (
        channel_encoding(Channel(1, "/imu", "cdr", {}, 3), summary) == "application/cdr;sensor_msgs/msg/Imu"
    )
    assert channel_encoding(Channel(1, "/s", "json", {}, 0), summary) == "application/json"
    noted = Channel(1, "/x", "cdr", {"zenoh_encoding": "application/cdr;acme/msg/X"}, 0)
    assert channel_encoding(noted, summary) == "application/cdr;acme/msg/X"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rate": 0.0}, "rate = 0.0 must be > 0"),
        ({"loop": -1}, "loop = -1 must be >= 0"),
        ({"start_s": -1.0}, "start_s = -1.0 must be >= 0"),
        ({"start_s": 2.0, "end_s": 2.0}, "end_s = 2.0 must be > start_s = 2.0"),
        ({"stamp": "later"}, "stamp = 'later' must be"),
    ],
)
def test_settings_out_of_bounds_are_refused_in_a_sentence(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ReplayError, match=words):
        settings(**changes)


def test_a_log_that_cannot_be_replayed_is_refused_before_the_bus_is_opened(tmp_path: Path) -> None:
    log = write_log(tmp_path / "log.mcap")
    with pytest.raises(ReplayError, match=r"past the log's end at 1\.000 s"):
        replay(settings(log, start_s=5.0))
    with pytest.raises(ReplayError, match="cannot open the log"):
        replay(settings(tmp_path / "absent.mcap"))
    notes = tmp_path / "README.md"
    notes.write_text("# Notes")
    with pytest.raises(ReplayError, match=r"README\.md is not an MCAP file$"):
        replay(settings(notes))
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[:-40])
    with pytest.raises(ReplayError, match="recover it first"):
        replay(settings(cut))
    with pytest.raises(ReplayError, match="has no messages"):
        replay(settings(write_log(tmp_path / "empty.mcap", topics=())))

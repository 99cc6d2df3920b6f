"""A log replayed onto a real Zenoh bus and recorded off it again; a recorder killed outright."""

from __future__ import annotations

import itertools
import json
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import defaultdict
from pathlib import Path

import pytest
from foxglove_schemas_protobuf.JointState_pb2 import JointState
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from mcap.reader import make_reader
from mcap.records import Message
from mcap.writer import Writer
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from shaper.bus import BusSettings
from straitlink.record import RecordSettings, RecordSummary, record
from straitlink.recording import recover
from straitlink.replay import ReplaySettings, ReplaySummary, replay
from straitlink.schemas import SchemaLibrary, payload_type

pytestmark = pytest.mark.live
ROOT = Path(__file__).resolve().parents[2]
LOGS = ROOT.parent / "shared" / "data" / "logs"
LOG_START_NS = 1_767_225_600_000_000_000
MS = 1_000_000


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def write_log(path: Path, messages: int = 120) -> None:
    """Protobuf, CDR and JSON channels, one message of each every 5 ms, captured 2 ms before logged."""
    types = get_typestore(Stores.LATEST)
    temperature = types.types["std_msgs/msg/Float64"]
    joints = SchemaLibrary().find(payload_type("application/protobuf;foxglove.JointStates"))
    float64 = SchemaLibrary().find(payload_type("application/cdr;std_msgs/msg/Float64"))
    assert joints and float64
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=4096)
        writer.start()
        channels = [
            writer.register_channel("/joints", "protobuf", writer.register_schema(joints.name, joints.encoding, joints.data)),
            writer.register_channel("/temperature", "cdr", writer.register_schema(float64.name, float64.encoding, float64.data)),
            writer.register_channel("/status", "json", 0),
        ]  # fmt: skip
        for number in range(messages):
            payloads = (
                JointStates(joints=[JointState(name="knee", position=0.1 * number)]).SerializeToString(),
                bytes(types.serialize_cdr(temperature(0.5 * number), "std_msgs/msg/Float64")),
                json.dumps({"number": number, "padding": "x" * (7 * number % 5000)}).encode(),
            )
            log_ns = LOG_START_NS + number * 5 * MS
            for channel, payload in zip(channels, payloads, strict=True):
                writer.add_message(channel, log_ns, payload, log_ns - 2 * MS - number, sequence=number + 7)
        writer.finish()


def messages_by_topic(path: Path) -> dict[str, list[Message]]:
    topics: dict[str, list[Message]] = defaultdict(list)
    with path.open("rb") as stream:
        for _schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            topics[channel.topic].append(message)
    return topics


def replay_into_recorder(
    log: Path, out: Path, logs: tuple[Path, ...] = (), **settings: object
) -> tuple[ReplaySummary, RecordSummary]:
    endpoint = free_endpoint()
    stop, ready = threading.Event(), threading.Event()
    made: list[RecordSummary] = []
    bus = BusSettings(listen=[endpoint])
    recording = RecordSettings(
        out, bus, logs=logs, stop=stop, on_ready=ready.set, metadata={"run": "live test"}
    )
    recorder = threading.Thread(target=lambda: made.append(record(recording)))
    recorder.start()
    try:
        assert ready.wait(5)
        replayed = replay(ReplaySettings(log, BusSettings(connect=[endpoint]), **settings))  # type: ignore[arg-type]
        time.sleep(0.2)
    finally:
        stop.set()
        recorder.join()
    return replayed, made[0]


def test_a_replayed_log_is_recorded_byte_for_byte_with_its_stamps(tmp_path: Path) -> None:
    log, out = tmp_path / "log.mcap", tmp_path / "out.mcap"
    write_log(log)
    replayed, recorded = replay_into_recorder(log, out, stamp="log")

    sent, got = messages_by_topic(log), messages_by_topic(out)
    assert {topic: [m.data for m in ms] for topic, ms in got.items()} == {
        topic: [m.data for m in ms] for topic, ms in sent.items()
    }
    for topic, messages in got.items():
        assert [(m.publish_time, m.sequence) for m in messages] == [
            (m.publish_time, m.sequence) for m in sent[topic]
        ]
    assert replayed.messages == recorded.messages == 360
    assert recorded.dropped == 0
    assert recorded.schemaless == ("/status",)
    assert replayed.unmatched_topics == ()


def test_capture_times_move_to_the_present_by_one_constant_and_arrivals_keep_the_logs_pace(
    tmp_path: Path,
) -> None:
    log, out = tmp_path / "log.mcap", tmp_path / "out.mcap"
    write_log(log)
    before_ns = time.time_ns()
    replay_into_recorder(log, out)

    sent, got = messages_by_topic(log), messages_by_topic(out)
    shifts = {m.publish_time - s.publish_time for t in got for m, s in zip(got[t], sent[t], strict=True)}
    assert len(shifts) == 1
    assert before_ns < LOG_START_NS + shifts.pop() < time.time_ns()
    joints = got["/joints"]
    assert (joints[-1].log_time - joints[0].log_time) / 1e9 == pytest.approx(119 * 0.005, abs=0.1)
    ages_ns = [m.log_time - m.publish_time for m in joints]
    assert 2 * MS <= sorted(ages_ns)[len(ages_ns) // 2] < 30 * MS


def test_channels_and_schemas_survive_and_rosbags_reads_the_cdr_part(tmp_path: Path) -> None:
    log, out = tmp_path / "log.mcap", tmp_path / "out.mcap"
    write_log(log)
    replay_into_recorder(log, out, logs=(log,), include=("/temperature", "joints"), rate=4.0)

    with out.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary and summary.statistics
    kinds = {
        c.topic: (c.message_encoding, summary.schemas[c.schema_id].name) for c in summary.channels.values()
    }
    assert kinds == {
        "/joints": ("protobuf", "foxglove.JointStates"),
        "/temperature": ("cdr", "std_msgs/msg/Float64"),
    }
    assert (summary.statistics.message_count, summary.statistics.metadata_count) == (240, 1)
    assert summary.statistics.attachment_count == 1

    with AnyReader([recover(out, message_encodings=("cdr",))]) as reader:
        values = [reader.deserialize(data, c.msgtype).data for c, _t, data in reader.messages()]  # type: ignore[attr-defined]
    assert values == [0.5 * number for number in range(120)]


@pytest.mark.skipif(not LOGS.is_dir(), reason="reference logs are not beside the repository")
def test_a_real_log_survives_at_sixteen_times_its_pace_and_opens_as_a_ros2_bag(tmp_path: Path) -> None:
    log, out = LOGS / "tilt_laser_ros2.mcap", tmp_path / "out.mcap"
    replayed, recorded = replay_into_recorder(log, out, logs=(log,), rate=16.0)
    assert replayed.messages == recorded.messages == 3025
    sent, got = messages_by_topic(log), messages_by_topic(out)
    assert {t: [m.data for m in ms] for t, ms in got.items()} == {
        t: [m.data for m in ms] for t, ms in sent.items()
    }
    with AnyReader([out]) as reader:
        [scans] = [connection for connection in reader.connections if connection.topic == "/scan"]
        _connection, _t, data = next(reader.messages([scans]))
        assert len(reader.deserialize(data, scans.msgtype).ranges) == 1078  # type: ignore[attr-defined]


def test_a_recorder_killed_outright_leaves_all_but_the_last_second(tmp_path: Path) -> None:
    log, out = tmp_path / "log.mcap", tmp_path / "out.mcap"
    write_log(log, messages=300)  # 1.5 s
    endpoint = free_endpoint()
    program = (
        "import sys; from pathlib import Path; from shaper.bus import BusSettings\n"
        "from straitlink.record import RecordSettings, record\n"
        "record(RecordSettings(Path(sys.argv[1]), BusSettings(listen=[sys.argv[2]]), flush_interval_s=0.5,\n"
        "       on_ready=lambda: print('ready', flush=True)))\n"
    )
    recorder = subprocess.Popen(
        [sys.executable, "-c", program, str(out), endpoint], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    try:
        assert recorder.stdout and recorder.stdout.readline() == "ready\n"
        replay(ReplaySettings(log, BusSettings(connect=[endpoint]), stamp="log"))
    finally:
        recorder.send_signal(signal.SIGKILL)
        recorder.wait(5)
        assert recorder.stdout
        recorder.stdout.close()

    sent, got = messages_by_topic(log), messages_by_topic(recover(out))
    for topic in ("/joints", "/temperature", "/status"):
        assert len(got[topic]) >= 190
        assert [m.data for m in got[topic]] == [m.data for m in sent[topic][: len(got[topic])]]


def test_a_second_pass_follows_the_first_and_a_stop_ends_it(tmp_path: Path) -> None:
    log, out = tmp_path / "log.mcap", tmp_path / "out.mcap"
    write_log(log)
    replayed, _ = replay_into_recorder(log, out, include=("/joints",), loop=2, rate=4.0)
    joints = messages_by_topic(out)["/joints"]
    assert (replayed.passes, replayed.messages, len(joints)) == (2, 240, 240)
    assert [m.sequence for m in joints] == list(range(7, 247))
    assert all(later.publish_time > earlier.publish_time for earlier, later in itertools.pairwise(joints))

    stop = threading.Event()
    endless, _ = replay_into_recorder(
        log, tmp_path / "again.mcap", loop=0, stop=stop, on_progress=lambda _: stop.set()
    )
    assert endless.stopped and endless.passes == 0 and 0 < endless.messages < 360

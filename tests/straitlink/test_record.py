"""The recording as a file: what it holds, and what is left of it after the worst."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.records import Message
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from messages.attachment import Stamp
from shaper.bus import BusSettings
from straitlink import record as record_module
from straitlink.record import RecordSettings
from straitlink.recording import AttachedFile, RecordError, RecordingFile, intact_records, recover

S = 1_000_000_000
T0_NS = 1_800_000_000 * S
IMU = "application/cdr;std_msgs/msg/Float64"


def write_recording(
    path: Path, encodings: tuple[str, ...] = (IMU, "application/json"), messages: int = 60
) -> bytes:
    """A message of each encoding per 10 ms, a chunk each 10 messages; the file's bytes."""
    types = get_typestore(Stores.LATEST)
    float64 = types.types["std_msgs/msg/Float64"]
    file = RecordingFile(path.open("wb"))
    file.add_metadata("straitlink", {"profile": "trials"})
    file.add_attachment(AttachedFile("config.json", "application/json", b"{}"), T0_NS, T0_NS)
    for number in range(messages):
        for index, encoding in enumerate(encodings):
            payload = json.dumps({"number": number}).encode()
            if "cdr" in encoding:
                payload = bytes(types.serialize_cdr(float64(float(number)), "std_msgs/msg/Float64"))
            arrival_ns = T0_NS + number * S // 100
            file.write(f"/topic{index}", encoding, payload, Stamp(arrival_ns - S, number), arrival_ns)
        if number % 10 == 9:
            file.flush()
    file.finish()
    return path.read_bytes()


def payloads(path: Path) -> dict[str, list[bytes]]:
    found: dict[str, list[bytes]] = {}
    with path.open("rb") as stream:
        for _schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            found.setdefault(channel.topic, []).append(message.data)
    return found


def test_arrival_is_log_time_and_capture_is_publish_time(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    file = RecordingFile(path.open("wb"))
    file.write("/stamped", "application/json", b"{}", Stamp(T0_NS - 5 * S, 77), T0_NS)
    file.write("/plain", "application/json", b"{}", None, T0_NS + 1)
    file.write("/before_1970", "application/json", b"{}", Stamp(-5, 1), T0_NS + 2)
    file.finish()
    with path.open("rb") as stream:
        rows = [
            (c.topic, m.log_time, m.publish_time, m.sequence)
            for _s, c, m in make_reader(stream).iter_messages()
        ]
    assert rows == [
        ("/stamped", T0_NS, T0_NS - 5 * S, 77),
        ("/plain", T0_NS + 1, T0_NS + 1, 0),
        ("/before_1970", T0_NS + 2, 0, 1),
    ]


def test_a_recording_has_statistics_schemas_metadata_and_its_attachment(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_recording(path)
    with path.open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert summary and summary.statistics
        assert summary.statistics.message_count == 120
        assert {schema.name for schema in summary.schemas.values()} == {"std_msgs/msg/Float64"}
        assert [m.metadata for m in reader.iter_metadata()] == [{"profile": "trials"}]
        assert [a.name for a in reader.iter_attachments()] == ["config.json"]
        assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}


def test_an_unknown_schema_makes_a_schemaless_channel_that_remembers_its_name(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    file = RecordingFile(path.open("wb"))
    file.write("/x", "application/cdr;acme_msgs/msg/X", b"\0\1\0\0", None, T0_NS)
    file.finish()
    assert file.schemaless == {"/x"}
    with path.open("rb") as stream:
        [(schema, channel, _message)] = list(make_reader(stream).iter_messages())
    assert schema is None
    assert channel.metadata == {"zenoh_encoding": "application/cdr;acme_msgs/msg/X"}


def test_a_topic_that_changes_its_encoding_gets_a_second_channel(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    file = RecordingFile(path.open("wb"))
    for number, encoding in enumerate(("application/json", "image/jpeg", "application/json")):
        file.write("/x", encoding, b"{}", None, T0_NS + number)
    file.finish()
    with path.open("rb") as stream:
        kinds = [channel.message_encoding for _s, channel, _m in make_reader(stream).iter_messages()]
    assert kinds == ["json", "image/jpeg", "json"]


def test_a_recording_of_nothing_but_cdr_is_a_ros2_bag_that_rosbags_opens(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_recording(path, encodings=(IMU,))
    with AnyReader([path]) as reader:
        values = [reader.deserialize(data, c.msgtype).data for c, _t, data in reader.messages()]  # type: ignore[attr-defined]
    assert values == [float(number) for number in range(60)]


def test_the_cdr_part_of_a_mixed_recording_can_be_taken_out_for_rosbags(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_recording(path, encodings=(IMU, "application/json", "application/protobuf;foxglove.Log"))
    with AnyReader([recover(path, message_encodings=("cdr",))]) as reader:
        assert {connection.topic for connection in reader.connections} == {"/topic0"}
        assert reader.message_count == 60


def test_recovering_a_whole_file_keeps_everything(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    write_recording(path)
    copy = recover(path)
    assert copy == tmp_path / "a_recovered.mcap"
    assert payloads(copy) == payloads(path)
    with copy.open("rb") as stream:
        reader = make_reader(stream)
        assert [m.metadata for m in reader.iter_metadata()] == [{"profile": "trials"}]
        assert [a.data for a in reader.iter_attachments()] == [b"{}"]


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0.0, 1.0))
def test_a_file_cut_anywhere_gives_back_every_chunk_before_the_cut(tmp_path: Path, share: float) -> None:
    whole = tmp_path / "whole.mcap"
    data = whole.read_bytes() if whole.exists() else write_recording(whole)
    ends = chunk_ends(whole)
    cut = tmp_path / "cut.mcap"
    kept_bytes = 8 + round(share * (len(data) - 8))
    cut.write_bytes(data[:kept_bytes])

    got = payloads(recover(cut))
    chunks = sum(end <= kept_bytes for end in ends)
    assert {topic: len(rows) for topic, rows in got.items()} == {
        topic: 10 * chunks for topic in ("/topic0", "/topic1") if chunks
    }
    for topic, rows in got.items():
        assert rows == payloads(whole)[topic][: len(rows)]


def chunk_ends(path: Path) -> list[int]:
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None and len(summary.chunk_indexes) == 6
    return [chunk.chunk_start_offset + chunk.chunk_length for chunk in summary.chunk_indexes]


@settings(deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(position=st.floats(0.0, 1.0, exclude_max=True), flip=st.integers(1, 255))
@example(position=0.0, flip=4)  # the header's opcode becomes a message's
@example(position=0.03772531389167555, flip=128)  # a chunk's length past what a signed number holds
def test_a_damaged_byte_costs_at_most_what_depends_on_it(tmp_path: Path, position: float, flip: int) -> None:
    whole = tmp_path / "whole.mcap"
    data = bytearray(whole.read_bytes() if whole.exists() else write_recording(whole))
    data[8 + int(position * (len(data) - 8))] ^= flip
    sent = {m.data for m in messages_of(whole.read_bytes())}
    assert {m.data for m in messages_of(bytes(data))} <= sent


def messages_of(data: bytes) -> list[Message]:
    return [record for record in intact_records(io.BytesIO(data)) if isinstance(record, Message)]


def test_what_is_not_mcap_is_refused_and_nothing_is_overwritten(tmp_path: Path) -> None:
    text = tmp_path / "notes.txt"
    text.write_text("not a recording")
    with pytest.raises(RecordError, match=r"notes\.txt is not an MCAP file"):
        recover(text)
    assert not (tmp_path / "notes_recovered.txt").exists()
    with pytest.raises(RecordError, match="the file to be recovered itself"):
        recover(text, text)


class FakeSample:
    def __init__(self, payload_bytes: int) -> None:
        self.payload = bytes(payload_bytes)


def test_a_stalled_disk_costs_the_newest_arrivals_and_they_are_counted() -> None:
    each = 1000 + record_module._Arrivals.SAMPLE_BYTES
    arrivals = record_module._Arrivals(max_bytes=3 * each)
    for number in range(5):
        arrivals.add(number, FakeSample(1000))  # type: ignore[arg-type]
    assert (len(arrivals), arrivals.dropped) == (3, 2)
    taken = arrivals.take()
    assert taken is not None and taken[0] == 0
    arrivals.add(9, FakeSample(1000))  # type: ignore[arg-type]
    assert (len(arrivals), arrivals.dropped) == (3, 2)


def test_a_sample_larger_than_the_whole_queue_still_passes_alone() -> None:
    arrivals = record_module._Arrivals(max_bytes=10)
    arrivals.add(0, FakeSample(1000))  # type: ignore[arg-type]
    assert (len(arrivals), arrivals.dropped) == (1, 0)


def test_a_leading_slash_of_a_key_is_taken_as_a_topic_s(tmp_path: Path, session: FakeSession) -> None:
    settings = RecordSettings(tmp_path / "a.mcap", BusSettings(), keys=("/tilt/scan", "camera/**"))
    settings.stop.set()
    record_module.record(settings)
    assert session.keys == ["tilt/scan", "camera/**"]


def test_overlapping_keys_record_a_sample_once() -> None:
    subscriptions = list(record_module._subscriptions(("camera/**", "imu", "**")))
    assert [[str(key) for key in earlier] for _key, earlier in subscriptions] == [
        [],
        [],
        ["camera/**", "imu"],
    ]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"keys": ()}, "keys is empty"),
        ({"flush_interval_s": 1.5}, "flush_interval_s = 1.5 must be > 0 and <= 1"),
        ({"queue_bytes": 0}, "queue_bytes = 0 must be > 0"),
    ],
)
def test_settings_out_of_bounds_are_refused_in_a_sentence(changes: dict[str, object], words: str) -> None:
    with pytest.raises(RecordError, match=words):
        RecordSettings(Path("a.mcap"), BusSettings(), **changes)  # type: ignore[arg-type]


class Unreachable(Exception):
    """Stands for the bus that is not there."""


def no_bus(_settings: BusSettings) -> None:
    raise Unreachable


def test_an_existing_file_is_refused_before_the_bus_is_opened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(record_module, "open_bus", no_bus)
    out = tmp_path / "a.mcap"
    out.write_bytes(b"earlier")
    with pytest.raises(RecordError, match=r"a\.mcap exists: give another name, or --overwrite"):
        record_module.record(RecordSettings(out, BusSettings()))
    assert out.read_bytes() == b"earlier"


def test_a_bus_that_is_not_there_costs_no_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(record_module, "open_bus", no_bus)
    out = tmp_path / "a.mcap"
    with pytest.raises(Unreachable):
        record_module.record(RecordSettings(out, BusSettings()))
    assert not out.exists()
    out.write_bytes(b"earlier")
    with pytest.raises(Unreachable):
        record_module.record(RecordSettings(out, BusSettings(), overwrite=True))
    assert out.read_bytes() == b"earlier"


def test_a_file_of_schemas_that_is_none_is_told(tmp_path: Path) -> None:
    notes = tmp_path / "README.md"
    notes.write_text("# Notes")
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(write_recording(tmp_path / "whole.mcap")[:-40])
    told = {
        tmp_path / "absent.mcap": r"schemas: cannot read .*absent\.mcap: No such file or directory",
        notes: r"schemas: .*README\.md is not an MCAP file$",
        cut: r"schemas: .*cut\.mcap is not a finished MCAP file .*recover it first",
    }
    for path, words in told.items():
        with pytest.raises(RecordError, match=words):
            record_module.record(RecordSettings(tmp_path / "a.mcap", BusSettings(), logs=[path]))


class FakeSession:
    def __init__(self) -> None:
        self.closed = False
        self.keys: list[str] = []

    def declare_subscriber(self, key: object, _on_sample: object) -> None:
        assert not self.closed
        self.keys.append(str(key))

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def session(monkeypatch: pytest.MonkeyPatch) -> FakeSession:
    session = FakeSession()
    monkeypatch.setattr(record_module, "open_bus", lambda _settings: session)
    return session


def test_an_existing_file_is_replaced_on_demand(tmp_path: Path, session: FakeSession) -> None:
    out = tmp_path / "a.mcap"
    out.write_bytes(b"earlier")
    settings = RecordSettings(out, BusSettings(), overwrite=True)
    settings.stop.set()
    assert record_module.record(settings).messages == 0
    assert payloads(out) == {}
    assert session.closed


def test_a_place_that_cannot_be_written_is_told_and_the_bus_is_left(
    tmp_path: Path, session: FakeSession
) -> None:
    with pytest.raises(RecordError, match=r"cannot write .*/absent/a\.mcap: No such file"):
        record_module.record(RecordSettings(tmp_path / "absent" / "a.mcap", BusSettings()))
    assert session.closed

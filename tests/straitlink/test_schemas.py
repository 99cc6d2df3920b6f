"""Which schema a payload has, and how MCAP and Zenoh name it."""

from __future__ import annotations

from pathlib import Path

import pytest
from foxglove_schemas_protobuf.JointStates_pb2 import JointStates
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import Writer

from straitlink.schemas import (
    MEDIA_TYPES,
    PayloadType,
    Schema,
    SchemaLibrary,
    file_descriptor_set,
    payload_type,
    zenoh_encoding,
)

LOGS = Path(__file__).resolve().parents[2].parent / "shared" / "data" / "logs"


@pytest.mark.parametrize(
    ("message_encoding", "name", "encoding"),
    [
        ("protobuf", "foxglove.JointStates", "application/protobuf;foxglove.JointStates"),
        ("cdr", "sensor_msgs/msg/Imu", "application/cdr;sensor_msgs/msg/Imu"),
        ("json", "", "application/json"),
        ("ros1", "std_msgs/String", "application/ros1;std_msgs/String"),
        ("image/jpeg", "", "image/jpeg"),
    ],
)
def test_mcap_and_zenoh_name_a_payload_alike(message_encoding: str, name: str, encoding: str) -> None:
    assert zenoh_encoding(PayloadType(message_encoding, name)) == encoding
    assert payload_type(encoding) == PayloadType(message_encoding, name)


@given(st.text(st.characters(codec="utf-8")))
def test_any_zenoh_encoding_string_survives_the_way_through_mcap(encoding: str) -> None:
    described = payload_type(encoding)
    again = zenoh_encoding(described)
    # Only "image/jpeg;" (an empty schema) and a bare MCAP name ("cdr") have a second spelling.
    media_type = encoding.partition(";")[0]
    if not encoding.endswith(";") and media_type not in MEDIA_TYPES:
        assert again == encoding
    assert (
        payload_type(again) == PayloadType(described.message_encoding, described.schema_name)
        or media_type in MEDIA_TYPES
    )


def test_a_foxglove_schema_is_a_descriptor_set_with_its_imports_first() -> None:
    found = SchemaLibrary().find(PayloadType("protobuf", "foxglove.JointStates"))
    assert found is not None
    names = [file.name for file in FileDescriptorSet.FromString(found.data).file]
    assert names[-1] == JointStates.DESCRIPTOR.file.name
    assert "google/protobuf/timestamp.proto" in names[:-1]
    assert len(set(names)) == len(names)
    assert file_descriptor_set(JointStates.DESCRIPTOR) == FileDescriptorSet.FromString(found.data)


def test_our_own_messages_are_found_by_name_alone() -> None:
    found = SchemaLibrary().find(PayloadType("protobuf", "straitlink.Heartbeat"))
    assert found is not None
    files = FileDescriptorSet.FromString(found.data).file
    assert files[-1].package == "straitlink"
    assert "Heartbeat" in [message.name for message in files[-1].message_type]


def test_a_ros2_schema_carries_its_nested_definitions() -> None:
    found = SchemaLibrary().find(PayloadType("cdr", "sensor_msgs/msg/JointState"))
    assert found is not None
    assert found.encoding == "ros2msg"
    assert b"float64[] position" in found.data
    assert b"MSG: std_msgs/Header" in found.data


@pytest.mark.parametrize(
    "unknown",
    [
        PayloadType("protobuf", "acme.Secret"),
        PayloadType("protobuf", "foxglove.NoSuchThing"),
        PayloadType("cdr", "acme_msgs/msg/Secret"),
        PayloadType("cdr", ""),
        PayloadType("json", "Status"),
        PayloadType("image/jpeg", ""),
    ],
)
def test_an_unknown_schema_is_none_and_no_error(unknown: PayloadType) -> None:
    assert SchemaLibrary().find(unknown) is None


def test_a_log_teaches_schemas_that_no_package_has_even_after_a_miss(tmp_path: Path) -> None:
    library = SchemaLibrary()
    wanted = PayloadType("cdr", "acme_msgs/msg/Secret")
    assert library.find(wanted) is None
    log = tmp_path / "log.mcap"
    with log.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.register_channel(
            "/secret", "cdr", writer.register_schema("acme_msgs/msg/Secret", "ros2msg", b"int8 x")
        )
        writer.register_channel("/plain", "json", 0)
        writer.finish()
    assert library.add_log(log) == 1
    assert library.find(wanted) == Schema("acme_msgs/msg/Secret", "ros2msg", b"int8 x")


def test_the_first_definition_of_a_name_wins() -> None:
    library = SchemaLibrary()
    library.add("cdr", Schema("a/msg/B", "ros2msg", b"int8 x"))
    library.add("cdr", Schema("a/msg/B", "ros2msg", b"int16 x"))
    found = library.find(PayloadType("cdr", "a/msg/B"))
    assert found is not None and found.data == b"int8 x"


@pytest.mark.skipif(not LOGS.is_dir(), reason="reference logs are not beside the repository")
def test_the_reference_logs_list_their_schemas() -> None:
    library = SchemaLibrary()
    counts = {path.name: library.add_log(path) for path in sorted(LOGS.glob("*.mcap"))}
    assert counts == {"g1_teleop_ep001.mcap": 3, "tilt_laser_ros2.mcap": 7}
    scan = library.find(PayloadType("cdr", "sensor_msgs/msg/LaserScan"))
    assert scan is not None and len(scan.data) == 482

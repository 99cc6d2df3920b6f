"""What a payload is: MCAP channel types, Zenoh encoding strings, and where their schemas come from."""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, Protocol

from google.protobuf import descriptor_pool
from google.protobuf.descriptor import Descriptor, FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.base import TypesysError
from rosbags.typesys.store import Typestore

# The one table of both directions: MCAP message encoding <-> media type of the Zenoh encoding string.
# The part after ";" of the Zenoh string is the schema's name. Any other media type ("image/jpeg") is
# an MCAP message encoding of the same name, and back.
MEDIA_TYPES: dict[str, str] = {
    "protobuf": "application/protobuf",
    "cdr": "application/cdr",
    "json": "application/json",
    "cbor": "application/cbor",
    "msgpack": "application/msgpack",
    "flatbuffer": "application/flatbuffer",
    "capnproto": "application/capnproto",
    "ros1": "application/ros1",
}
_MESSAGE_ENCODINGS = {media_type: name for name, media_type in MEDIA_TYPES.items()}

ZENOH_ENCODING_KEY = "zenoh_encoding"  # channel metadata of a recording whose schema nobody knew


@dataclass(frozen=True, slots=True)
class Schema:
    """A schema as MCAP stores it.

    encoding: MCAP's well-known name: "protobuf" (data: a FileDescriptorSet), "ros2msg", "jsonschema"...
    """

    name: str
    encoding: str
    data: bytes


@dataclass(frozen=True, slots=True)
class PayloadType:
    """What an MCAP channel and a Zenoh encoding string both say; schema_name is "" for schemaless."""

    message_encoding: str
    schema_name: str = ""


def zenoh_encoding(payload_type: PayloadType) -> str:
    """("cdr", "sensor_msgs/msg/Imu") -> "application/cdr;sensor_msgs/msg/Imu"."""
    media_type = MEDIA_TYPES.get(payload_type.message_encoding, payload_type.message_encoding)
    return f"{media_type};{payload_type.schema_name}" if payload_type.schema_name else media_type


def payload_type(encoding: str) -> PayloadType:
    """ "application/cdr;sensor_msgs/msg/Imu" -> ("cdr", "sensor_msgs/msg/Imu"); total on any string."""
    media_type, _, schema_name = encoding.partition(";")
    return PayloadType(_MESSAGE_ENCODINGS.get(media_type, media_type), schema_name)


class SchemaLibrary:
    """Finds the schema of a payload type: in the logs added, then in the generated code installed.

    A recorder on a Zenoh bus sees names only; a schema that nobody knows stays None and its channel
    schemaless, so that recording never stops for want of a definition.
    """

    def __init__(self) -> None:
        self._known: dict[PayloadType, Schema | None] = {}

    def add(self, message_encoding: str, schema: Schema) -> None:
        """Remember a schema; the first one of a name wins."""
        payload_type = PayloadType(message_encoding, schema.name)
        if self._known.get(payload_type) is None:
            self._known[payload_type] = schema

    def add_log(self, path: Path) -> int:
        """Remember every channel's schema of an MCAP file with a summary; returns how many channels had one.

        Raises ValueError for a file without a summary section, and mcap.exceptions.McapError for
        one that is not MCAP or is unfinished (see straitlink.record.recover).
        """
        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        if summary is None:
            raise ValueError(f"{path} has no summary section, so its schemas cannot be listed")
        described = [channel for channel in summary.channels.values() if channel.schema_id in summary.schemas]
        for channel in described:
            schema = summary.schemas[channel.schema_id]
            self.add(channel.message_encoding, Schema(schema.name, schema.encoding, schema.data))
        return len(described)

    def find(self, wanted: PayloadType) -> Schema | None:
        """The schema of a payload type, or None if no source knows it."""
        if wanted not in self._known:
            self._known[wanted] = _look_up(wanted)
        return self._known[wanted]


def _look_up(wanted: PayloadType) -> Schema | None:
    if not wanted.schema_name:
        return None
    if wanted.message_encoding == "protobuf":
        return _protobuf_schema(wanted.schema_name)
    if wanted.message_encoding == "cdr":
        return _ros2_schema(wanted.schema_name)
    return None


def _protobuf_schema(name: str) -> Schema | None:
    descriptor = _pooled(name)
    if descriptor is None:
        _import_generated_code(name)
        descriptor = _pooled(name)
    if descriptor is None:
        return None
    return Schema(name, "protobuf", file_descriptor_set(descriptor).SerializeToString(deterministic=True))


class Described(Protocol):
    """A message's descriptor, of either protobuf implementation."""

    @property
    def file(self) -> Any: ...


def file_descriptor_set(descriptor: Described) -> FileDescriptorSet:
    """A message's .proto file and all that it imports, imports first, as MCAP wants protobuf schemas."""
    files = FileDescriptorSet()
    seen: set[str] = set()

    def append(file: FileDescriptor) -> None:
        if file.name in seen:
            return
        seen.add(file.name)
        for dependency in file.dependencies:
            append(dependency)
        file.CopyToProto(files.file.add())

    append(descriptor.file)
    return files


def _pooled(name: str) -> Descriptor | None:
    pool: Any = descriptor_pool.Default()
    try:
        found: Descriptor = pool.FindMessageTypeByName(name)
    except KeyError:
        return None
    return found


def _import_generated_code(name: str) -> None:
    """Import what would put the message into protobuf's pool: foxglove's module, or all of ours."""
    package, _, short = name.rpartition(".")
    if package == "foxglove":
        _import_if_there(f"foxglove_schemas_protobuf.{short}_pb2")
    else:
        _import_catalogue()


@cache
def _import_catalogue() -> None:
    for module in _catalogue_modules():
        _import_if_there(module)


def _catalogue_modules() -> Iterator[str]:
    """The generated modules below messages/proto, which need not be a regular package."""
    catalogue = _import_if_there("messages.proto")
    for root in map(Path, catalogue.__path__ if catalogue else ()):
        for path in sorted(root.rglob("*_pb2.py")):
            yield ".".join(("messages", "proto", *path.relative_to(root).with_suffix("").parts))


def _import_if_there(module: str) -> ModuleType | None:
    try:
        return importlib.import_module(module)
    except (ImportError, TypeError):  # TypeError: protobuf on generated code that the pool refuses
        return None


def _ros2_schema(name: str) -> Schema | None:
    try:
        definition, _digest = _ros2_types().generate_msgdef(name, ros_version=2)
    except TypesysError:
        return None
    return Schema(name, "ros2msg", definition.encode())


@cache
def _ros2_types() -> Typestore:
    return get_typestore(Stores.LATEST)

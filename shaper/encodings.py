"""[encodings.NAME] of a configuration: schemas and dictionaries, read from beside it and checked once."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pydantic import BaseModel, ConfigDict, model_validator

from messages.payload import PayloadError, TopicEncoding
from shaper.errors import ConfigError

if TYPE_CHECKING:
    from google.protobuf.message import Message


class EncodingTable(BaseModel):
    """One encoding: of a .proto file's message, of a message of the catalogue, or a zstd dictionary.

    schema, dictionary: paths from the configuration's folder.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, protected_namespaces=())

    proto: str | None = None
    message: str | None = None
    dictionary: str | None = None
    out_of_range: Literal["raise", "clamp"] = "raise"
    assume: str = ""
    publish: str = ""
    delta: bool = False

    @model_validator(mode="after")
    def _is_one_kind(self) -> EncodingTable:
        if (self.dictionary is None) == (self.proto is None and self.message is None):
            raise ValueError("expected either proto and message (or message alone), or dictionary")
        extras = self.assume or self.publish or self.delta or self.out_of_range != "raise"
        if self.dictionary is not None and extras:
            raise ValueError("out_of_range, assume, publish and delta go with a message, not a dictionary")
        return self


def build_encoding(where: str, table: EncodingTable, folder: Path) -> TopicEncoding:
    """The encoding that a table describes. Raises ConfigError starting with `where`."""
    # Imported here: what codecs and ROS 2 types take to load is not for shapers without encodings.
    from messages.dccl import DcclError

    try:
        if table.dictionary is not None:
            return _dictionary(folder / table.dictionary)
        return _bounded(table, folder)
    except OSError as error:
        raise ConfigError(f"{where}: {error.filename} cannot be read: {error.strerror}") from error
    except (DcclError, PayloadError) as error:
        raise ConfigError(f"{where}: {error}") from error


def _dictionary(path: Path) -> TopicEncoding:
    from messages.payload.dictionary import DictionaryEncoding

    return DictionaryEncoding(path.read_bytes())


def _bounded(table: EncodingTable, folder: Path) -> TopicEncoding:
    from messages.payload.bounded import BoundedEncoding
    from messages.payload.delta import DeltaEncoding
    from messages.payload.maps import maps_of
    from messages.payload.processes import ProcessEncoding
    from messages.proto.straitlink.bounded.process_report_pb2 import ProcessReport

    message_type = _message_type(table, folder)
    if message_type is ProcessReport:
        return ProcessEncoding(out_of_range=table.out_of_range, assume=table.assume, publish=table.publish)
    return (DeltaEncoding if table.delta else BoundedEncoding)(
        message_type,
        maps_of(message_type),
        out_of_range=table.out_of_range,
        assume=table.assume,
        publish=table.publish,
    )


def _message_type(table: EncodingTable, folder: Path) -> type[Message]:
    from messages.bounded_catalogue import BOUNDED_CATALOGUE, find_bounded
    from messages.dccl import load_proto, sendable_types

    if table.proto is None:
        found = find_bounded(table.message or "")
        if found is None:
            known = ", ".join(message.name for message in BOUNDED_CATALOGUE)
            raise PayloadError(f"message = {table.message!r}: the catalogue has {known}; or give proto")
        return found.message_type
    types = sendable_types(load_proto(folder / table.proto))
    if table.message is None and len(types) == 1:
        return next(iter(types.values()))
    if table.message not in types:
        raise PayloadError(f"message = {table.message!r}: {table.proto} has {', '.join(types) or 'none'}")
    return types[table.message]

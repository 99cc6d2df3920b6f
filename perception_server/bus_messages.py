"""Requests, replies and their status as they are on a bus."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import TypeAlias

from google.protobuf import json_format
from google.protobuf.message import DecodeError as ProtobufDecodeError

from messages.proto.straitlink.view_pb2 import Image, ImageRequest, View, ViewRequest
from perception_server.dispatch import Reply, Request
from perception_server.errors import RequestError
from perception_server.request_status import Status

VIEW_ENCODING = "application/protobuf;straitlink.View"
IMAGE_ENCODING = "application/protobuf;straitlink.Image"
RequestType: TypeAlias = type[ViewRequest] | type[ImageRequest]
_MAX_REQUEST_BYTES = 4096
_TRUTH = {"true": True, "false": False}


def parse_request(kind: RequestType, payload: bytes) -> Request:
    """A serialised request. Raises RequestError for bytes that are none."""
    if len(payload) > _MAX_REQUEST_BYTES:
        raise RequestError(f"request: {len(payload)} bytes: must be at most {_MAX_REQUEST_BYTES}")
    request = kind()
    try:
        request.ParseFromString(payload)
    except ProtobufDecodeError as error:
        raise RequestError(f"request: the bytes are no {kind.DESCRIPTOR.name}: {error}") from error
    return request


def request_from_fields(kind: RequestType, fields: Mapping[str, object]) -> Request:
    """A request from names and values, as TOML, a command line or a query's parameters have them.

    Enumerations by name, with or without their prefix ("FORMAT_JPEG", "jpeg"); numbers may be strings.
    Raises RequestError that names the field.
    """
    request = kind()
    for name, value in fields.items():
        descriptor = kind.DESCRIPTOR.fields_by_name.get(name)
        if descriptor is None:
            known = ", ".join(kind.DESCRIPTOR.fields_by_name)
            raise RequestError(f"{name}: unknown; must be one of {known}")
        if isinstance(value, str) and descriptor.enum_type is not None:
            value = _enum_name(descriptor.enum_type.values_by_name, name, value)
        elif isinstance(value, str) and value.lower() in _TRUTH and descriptor.type == descriptor.TYPE_BOOL:
            value = _TRUTH[value.lower()]
        try:
            json_format.ParseDict({name: value}, request)
        except json_format.ParseError as error:
            raise RequestError(f"{name} = {value!r}: {str(error).partition(': ')[2] or error}") from error
    return request


def fields_of(parameters: str) -> dict[str, str]:
    """Names and values of a Zenoh selector's parameters, "a=1;b=2"; Zenoh's own ("_time") are left out."""
    pairs = (each.partition("=") for each in parameters.split(";") if each)
    return {name: value for name, _, value in pairs if not name.startswith("_")}


def reply_encoding(reply: Reply) -> str:
    """The Zenoh encoding string of a reply."""
    return IMAGE_ENCODING if isinstance(reply, Image) else VIEW_ENCODING


def parse_reply(encoding: str, payload: bytes) -> Reply | None:
    """A reply by its encoding string; None for other encodings and for bytes that are none."""
    if encoding not in (VIEW_ENCODING, IMAGE_ENCODING):
        return None
    reply: Reply = View() if encoding == VIEW_ENCODING else Image()
    try:
        reply.ParseFromString(payload)
    except ProtobufDecodeError:
        return None
    return reply


def status_document(status: Status) -> bytes:
    """A status as JSON, with what is known of it."""
    document: dict[str, object] = {"request_id": status.request_id, "stage": status.stage.value}
    for name in ("key", "error", "size_bytes", "budget_bytes", "source_ns"):
        if value := getattr(status, name):
            document[name] = value
    return json.dumps(document, separators=(",", ":")).encode()


def _enum_name(known: Mapping[str, object], field: str, value: str) -> str:
    name = value.upper()
    for candidate in (name, *(each for each in known if each.endswith(f"_{name}"))):
        if candidate in known:
            return candidate
    raise RequestError(f"{field} = {value!r}: must be one of {', '.join(known)}")

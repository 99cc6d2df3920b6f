"""The perception server's configuration: TOML, checked once here."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from messages.proto.straitlink.view_pb2 import ImageRequest, ViewRequest
from perception_server.bus_messages import request_from_fields
from perception_server.dispatch import Request, Stream
from perception_server.errors import RequestError
from perception_server.history import HistoryLimits
from perception_server.scan_geometry import ScanPlacement, SelfBox
from perception_server.sensors import check_request
from shaper.bus import BusSettings
from shaper.config_tables import describe_validation_error
from shaper.errors import ConfigError
from shaper.key_expression import is_key

_NS_PER_S = 1_000_000_000
_LIMITS = HistoryLimits()


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ZenohTable(_Table):
    """[zenoh]: as in a shaper's configuration."""

    mode: Literal["peer", "client", "router"] | None = None
    listen: list[str] = []
    connect: list[str] = []
    config: dict[str, Any] = {}


class ServerTable(_Table):
    """[server]: the keys that requests come on and views leave on."""

    prefix: str = "robot/view"
    view_requests: str = "operator/view_request"
    image_requests: str = "operator/image_request"

    @field_validator("*")
    @classmethod
    def _is_key(cls, value: str) -> str:
        return _checked_key(value)


class HistoryTable(_Table):
    """[history]: what is kept; see HistoryLimits."""

    duration_s: Annotated[float, Field(ge=1, le=3600)] = _LIMITS.duration_s
    max_scan_points: Annotated[int, Field(ge=1, le=100_000_000)] = _LIMITS.max_scan_points
    max_cloud_points: Annotated[int, Field(ge=1, le=100_000_000)] = _LIMITS.max_cloud_points
    max_picture_bytes: Annotated[int, Field(ge=1, le=10_000_000_000)] = _LIMITS.max_picture_bytes
    max_frames: Annotated[int, Field(ge=1, le=10_000)] = _LIMITS.max_frames
    pose_wait_s: Annotated[float, Field(ge=0, le=60)] = _LIMITS.pose_wait_s
    max_waiting: Annotated[int, Field(ge=1, le=100_000)] = _LIMITS.max_waiting
    max_pose_gap_s: Annotated[float, Field(ge=0.001, le=60)] = _LIMITS.max_pose_gap_s


Metres3 = tuple[float, float, float]


class SelfBoxTable(_Table):
    """[[frames.self_boxes]]: a part of the robot; returns inside it are left out. Corners in its frame."""

    frame: str
    low_m: Metres3
    high_m: Metres3


class FramesTable(_Table):
    """[frames]: world is the fixed frame; the spindle's turning is told against sweep_frame ("": world)."""

    world: str = "map"
    sweep_frame: str = ""
    self_boxes: list[SelfBoxTable] = []


class InputTable(_Table):
    """[inputs.NAME]: a sensor's topic; requests know it as NAME.

    type: "foxglove.LaserScan", "sensor_msgs/msg/Image", ...: where its publisher does not say.
    mirror_period_s: of a scanner whose messages do not say when each beam was taken; else it is taken from
    the scans' stamps. static: transforms that hold at all times, as on keys that end in tf_static.
    """

    key: str
    type: str = ""
    mirror_period_s: Annotated[float, Field(gt=0, le=60)] | None = None
    static: bool = False

    @field_validator("key")
    @classmethod
    def _is_key(cls, value: str) -> str:
        return _checked_key(value)


class ViewTable(_Table):
    """[views.NAME]: a standing view. request: fields of ImageRequest or ViewRequest, mostly a preset."""

    kind: Literal["image", "geometry"]
    key: str | None = None
    period_s: Annotated[float, Field(ge=0, le=86_400, allow_inf_nan=False)] = 1.0
    form: Literal["straitlink", "foxglove"] = "straitlink"
    request: dict[str, Any]

    @field_validator("key")
    @classmethod
    def _is_key(cls, value: str | None) -> str | None:
        return value if value is None else _checked_key(value)


class PerceptionTable(_Table):
    """The whole file."""

    zenoh: ZenohTable
    server: ServerTable = ServerTable()
    history: HistoryTable = HistoryTable()
    frames: FramesTable = FramesTable()
    inputs: Annotated[dict[str, InputTable], Field(min_length=1)]
    views: dict[str, ViewTable] = {}


TABLES: dict[str, type[BaseModel]] = {
    "zenoh": ZenohTable,
    "server": ServerTable,
    "history": HistoryTable,
    "frames": FramesTable,
    "self_boxes": SelfBoxTable,
    "inputs": InputTable,
    "views": ViewTable,
}


@dataclass(frozen=True, slots=True)
class Input:
    """A sensor's topic. type: "" where the publisher says it."""

    name: str
    key: str
    type: str


@dataclass(frozen=True, slots=True)
class PerceptionConfig:
    """What a file says, in the core's values. foxglove_keys: streams that leave as CompressedImage."""

    bus: BusSettings
    server: ServerTable
    limits: HistoryLimits
    placement: ScanPlacement
    mirror_period_s: Mapping[str, float]
    static_sources: frozenset[str]
    inputs: tuple[Input, ...]
    streams: tuple[Stream, ...]
    foxglove_keys: frozenset[str]


def load_perception_config(path: Path) -> PerceptionConfig:
    """Read and check a perception server's TOML file. Raises ConfigError: file, field, value, bound."""
    try:
        values = tomllib.loads(path.read_text())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: is not TOML: {error}") from error
    try:
        table = PerceptionTable.model_validate(values)
    except ValidationError as error:
        raise ConfigError(describe_validation_error(path, error, PerceptionTable, TABLES)) from error
    return _from_table(table, path)


def _from_table(table: PerceptionTable, path: Path) -> PerceptionConfig:
    limits = HistoryLimits(**{each.name: getattr(table.history, each.name) for each in fields(HistoryLimits)})
    streams = tuple(_stream(path, name, view, table) for name, view in table.views.items())
    keys = [stream.key for stream in streams]
    for name, key in zip(table.views, keys, strict=True):
        if keys.count(key) > 1 or key == f"{table.server.prefix}/requested":
            raise ConfigError(f"{path}: views.{name}: its key {key!r} is another view's too")
    zenoh = table.zenoh
    return PerceptionConfig(
        BusSettings(zenoh.listen, zenoh.connect, zenoh.mode, zenoh.config),
        table.server,
        limits,
        _placement(table.frames),
        {name: each.mirror_period_s for name, each in table.inputs.items() if each.mirror_period_s},
        frozenset(n for n, each in table.inputs.items() if each.static or each.key.endswith("tf_static")),
        tuple(Input(name, each.key, each.type) for name, each in table.inputs.items()),
        streams,
        frozenset(
            key for key, view in zip(keys, table.views.values(), strict=True) if view.form == "foxglove"
        ),
    )


def _placement(table: FramesTable) -> ScanPlacement:
    boxes = tuple(SelfBox(each.frame, each.low_m, each.high_m) for each in table.self_boxes)
    return ScanPlacement(table.world, table.sweep_frame, boxes)


def _stream(path: Path, name: str, view: ViewTable, table: PerceptionTable) -> Stream:
    where = f"{path}: views.{name}"
    try:
        request = _request(view.kind, view.request)
    except RequestError as error:
        raise ConfigError(f"{where}.request.{error}") from error
    if isinstance(request, ImageRequest) and request.source and request.source not in table.inputs:
        known = ", ".join(table.inputs)
        raise ConfigError(f"{where}.request.source = {request.source!r}: must be one of {known}")
    if view.form == "foxglove" and not isinstance(request, ImageRequest):
        raise ConfigError(f'{where}.form = "foxglove": is for kind = "image"; the operator converts the rest')
    key = view.key or f"{table.server.prefix}/{name}"
    if not is_key(key):
        raise ConfigError(f"{where}: {key!r} is no key: rename the view, or say key")
    return Stream(key, request, round(view.period_s * _NS_PER_S))


def _request(kind: Literal["image", "geometry"], said: Mapping[str, object]) -> Request:
    request = request_from_fields(ImageRequest if kind == "image" else ViewRequest, said)
    for name in ("request_id", "period_ms", "duration_s"):
        if name in said:
            raise RequestError(f"{name} = {said[name]!r}: a standing view has period_s instead")
    check_request(request)
    return request


def _checked_key(value: str) -> str:
    if not is_key(value):
        raise ValueError(f"expected a Zenoh key without wildcards, not {value!r}")
    return value

"""A shaper's configuration: TOML, checked once here, turned into the values that the core counts with."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from messages.payload import StreamEncoding, TopicEncoding
from shaper.bus import BusSettings
from shaper.encodings import EncodingTable, build_encoding
from shaper.endpoint_settings import EndpointSettings
from shaper.errors import ConfigError
from shaper.incoming import Limits
from shaper.key_expression import check_key_expression, is_key
from shaper.link_estimator import PresetBand
from shaper.operator_lost import OperatorLostSettings
from shaper.traffic_class import DEFAULT_CLASSES, Compression, Entries, Keep, TopicRule, TrafficClass
from shaper.wire_type import by_digest

JOURNAL_OFF = "off"
_NS_PER_MS = 1_000_000
_NS_PER_S = 1_000_000_000


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ClassTable(_Table):
    """[classes.NAME]: what is not given is taken from the built-in class of that name, if there is one."""

    tier: Annotated[int, Field(ge=0, le=255)] | None = None
    keep: Keep | None = None
    ttl_ms: Annotated[float, Field(gt=0, le=86_400_000, allow_inf_nan=False)] | None = None
    depth: Annotated[int, Field(ge=1, le=100_000)] | None = None
    always_send: bool | None = None
    reliable: bool | None = None
    max_parity_ratio: Annotated[float, Field(ge=0, le=2)] | None = None
    target_ratio: Annotated[float, Field(gt=0, lt=1)] | None = None


class _TierTable(_Table):
    guaranteed_ratio: Annotated[float, Field(gt=0, lt=1)]


class _EntriesTable(_Table):
    field: Annotated[int, Field(ge=1, le=536_870_911)]
    key: Annotated[int, Field(ge=1, le=536_870_911)]
    ignored: list[int] = []
    ignored_outside: list[int] = []

    def to_entries(self) -> Entries:
        return Entries(self.field, self.key, frozenset(self.ignored), frozenset(self.ignored_outside))


class _TopicTable(_Table):
    key: str
    traffic_class: str = Field(alias="class")
    max_hz: Annotated[float, Field(ge=1e-6, le=100_000, allow_inf_nan=False)] | None = None
    compression: Compression = Compression.RAW
    weight: Annotated[float, Field(ge=0.001, le=1000)] = 1.0
    entries: _EntriesTable | None = None
    pull: bool = False
    encoding: str | None = None

    @field_validator("key")
    @classmethod
    def _is_key_expression(cls, value: str) -> str:
        return _checked_expression(value)


class _BandTable(_Table):
    name: str
    rate_bps: Annotated[int, Field(ge=1000, le=10_000_000_000)]
    one_way_delay_ms: Annotated[float, Field(ge=0, le=60_000, allow_inf_nan=False)]


class _LinkTable(_Table):
    side: Literal["robot", "operator"]
    listen: str
    peer: str
    max_datagram_bytes: Annotated[int, Field(ge=300, le=1472)] = 1200
    pace_ratio: Annotated[float, Field(gt=0, le=1)] = 0.95
    estimator: Literal["presets", "adaptive"] = "presets"
    bands: list[_BandTable] = []
    accept: list[str] = ["**"]
    keys: list[str] = []
    open: bool = False
    journal: Annotated[str, Field(min_length=1)] | None = None

    @field_validator("listen", "peer")
    @classmethod
    def _is_address(cls, value: str) -> str:
        parse_address(value)
        return value

    @field_validator("accept")
    @classmethod
    def _are_key_expressions(cls, values: list[str]) -> list[str]:
        return [_checked_expression(value) for value in values]


class _ZenohTable(_Table):
    mode: Literal["peer", "client", "router"] | None = None
    listen: list[str] = []
    connect: list[str] = []
    config: dict[str, Any] = {}


class _LimitsTable(_Table):
    max_topics: Annotated[int, Field(ge=1, le=1_000_000)] = Limits().max_topics
    max_message_bytes: Annotated[int, Field(ge=1, le=1_000_000_000)] = Limits().max_message_bytes
    max_reassembly_bytes: Annotated[int, Field(ge=1, le=4_000_000_000)] = Limits().max_reassembly_bytes
    max_reassembly_wait_s: Annotated[float, Field(gt=0, le=86_400, allow_inf_nan=False)] = (
        Limits().max_reassembly_wait_ns / _NS_PER_S
    )
    max_unfinished_messages: Annotated[int, Field(ge=1, le=1_000_000)] = Limits().max_unfinished_messages
    max_receipts: Annotated[int, Field(ge=64, le=1_000_000)] = Limits().max_receipts
    max_journal_messages: Annotated[int, Field(ge=1, le=1_000_000)] = Limits().max_journal_messages
    max_journal_bytes: Annotated[int, Field(ge=1000, le=4_000_000_000)] = Limits().max_journal_bytes


class _MetricsTable(_Table):
    listen: str

    @field_validator("listen")
    @classmethod
    def _is_address(cls, value: str) -> str:
        parse_address(value)
        return value


class _OperatorLostTable(_Table):
    key: str
    payload: str
    after_s: Annotated[float, Field(ge=1.5, le=86_400, allow_inf_nan=False)] = 5.0
    repeat_s: Annotated[float, Field(ge=0.1, le=3600, allow_inf_nan=False)] = 1.0
    encoding: str = "text/plain"
    back_payload: str | None = None

    @field_validator("key")
    @classmethod
    def _is_key(cls, value: str) -> str:
        if not is_key(value):
            raise ValueError("expected a key without wildcards")
        return value

    def to_settings(self) -> OperatorLostSettings:
        back = None if self.back_payload is None else self.back_payload.encode()
        after_ns, repeat_ns = round(self.after_s * _NS_PER_S), round(self.repeat_s * _NS_PER_S)
        return OperatorLostSettings(self.key, self.payload.encode(), after_ns, repeat_ns, self.encoding, back)


class _ShaperTable(_Table):
    link: _LinkTable
    zenoh: _ZenohTable
    classes: dict[str, ClassTable] = {}
    tiers: dict[
        Annotated[str, Field(pattern=r"^(0|[1-9][0-9]?|1[0-9]{2}|2[0-4][0-9]|25[0-5])$")], _TierTable
    ] = {}
    metrics: _MetricsTable | None = None
    operator_lost: _OperatorLostTable | None = None
    topics: Annotated[list[_TopicTable], Field(min_length=1)]
    limits: _LimitsTable = _LimitsTable()
    encodings: dict[str, EncodingTable] = {}


@dataclass(frozen=True, slots=True)
class ShaperConfig:
    """Everything that `straitlink shaper` runs on.

    listen, peer: UDP (host, port) of this side and of the other. metrics: where Prometheus may ask.
    key_files: of link keys, the first to start with. open_link: no keys are wanted, loopback only.
    journal: where reliable messages are on record; None for nowhere. operator_lost: robot's side only.
    resolved: the configuration with all defaults filled in, to be saved beside a result.
    """

    side: Literal["robot", "operator"]
    listen: tuple[str, int]
    peer: tuple[str, int]
    bus: BusSettings
    endpoint: EndpointSettings
    bands: tuple[PresetBand, ...]
    pace_ratio: float
    estimator: Literal["presets", "adaptive"] = "presets"
    metrics: tuple[str, int] | None = None
    key_files: tuple[Path, ...] = ()
    open_link: bool = False
    journal: Path | None = None
    operator_lost: OperatorLostSettings | None = None
    resolved: dict[str, Any] = field(default_factory=dict)


def load_config(path: Path) -> ShaperConfig:
    """Read and check a shaper's TOML file. Raises ConfigError: file, field, value, what was expected."""
    try:
        values = tomllib.loads(path.read_text())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: is not TOML: {error}") from error
    try:
        table = _ShaperTable.model_validate(values)
    except ValidationError as error:
        raise ConfigError(describe_validation_error(path, error)) from error
    return _from_table(table, path)


def parse_address(text: str) -> tuple[str, int]:
    """ "host:port" as (host, port). Raises ValueError with what was expected."""
    host, colon, port = text.rpartition(":")
    if not colon or not host or not (port.isascii() and port.isdigit()) or not 0 < int(port) < 65_536:
        raise ValueError(
            f"expected host:port with a port of 1 to 65535, such as 127.0.0.1:9001, not {text!r}"
        )
    return host.strip("[]"), int(port)


def class_from_table(name: str, table: ClassTable, known: dict[str, TrafficClass]) -> TrafficClass:
    """A declared class, on top of a known one of the same name or of `state`."""
    base = known.get(name, DEFAULT_CLASSES["state"])
    made = TrafficClass(
        name=name,
        tier=base.tier if table.tier is None else table.tier,
        keep=base.keep if table.keep is None else table.keep,
        ttl_ns=base.ttl_ns if table.ttl_ms is None else round(table.ttl_ms * _NS_PER_MS),
        depth=base.depth if table.depth is None else table.depth,
        always_send=base.always_send if table.always_send is None else table.always_send,
        reliable=base.reliable if table.reliable is None else table.reliable,
        max_parity_ratio=base.max_parity_ratio if table.max_parity_ratio is None else table.max_parity_ratio,
        target_ratio=base.target_ratio if table.target_ratio is None else table.target_ratio,
    )
    if made.reliable and made.keep is Keep.LATEST:
        raise ConfigError(
            f'classes.{name}: reliable = true with keep = "latest": expected keep = "all" (each message is '
            'delivered) or "changes" (the newest state is)'
        )
    return made


def describe_validation_error(
    path: Path,
    error: ValidationError,
    root: type[BaseModel] | None = None,
    tables: Mapping[str, type[BaseModel]] | None = None,
) -> str:
    """Every problem on its own line: file, field, value, and what was expected.

    root, tables: of the file, to say which keys it may have; a shaper's unless given.
    """
    lines = []
    for problem in error.errors():
        where = "".join(f"[{p}]" if isinstance(p, int) else f".{p}" for p in problem["loc"]).lstrip(".")
        value = json.dumps(problem["input"], default=str)
        shown = value if len(value) <= 80 else value[:77] + "..."
        if problem["type"] == "extra_forbidden":
            known = _known_keys(problem["loc"], root or _ShaperTable, _TABLES if tables is None else tables)
            lines.append(f"{path}: {where} = {shown}: unknown key; expected one of {known}")
        elif problem["type"] == "missing":
            lines.append(f"{path}: {where}: is missing")
        else:
            reason = problem["msg"].removeprefix("Value error, ")
            lines.append(f"{path}: {where} = {shown}: {reason[0].lower()}{reason[1:]}")
    return "\n".join(lines)


def _known_keys(
    loc: tuple[int | str, ...], root: type[BaseModel], tables: Mapping[str, type[BaseModel]]
) -> str:
    """What may stand at a place, found by walking the tables down to it."""
    table = root
    for part in loc[:-1]:
        if table not in (ClassTable, EncodingTable) and not isinstance(part, int):
            table = tables.get(part, table)
    return ", ".join(f.alias or name for name, f in table.model_fields.items())


_TABLES: dict[str, type[BaseModel]] = {
    "link": _LinkTable,
    "bands": _BandTable,
    "zenoh": _ZenohTable,
    "classes": ClassTable,
    "topics": _TopicTable,
    "limits": _LimitsTable,
    "tiers": _TierTable,
    "entries": _EntriesTable,
    "metrics": _MetricsTable,
    "operator_lost": _OperatorLostTable,
    "encodings": EncodingTable,
}


def _checked_expression(value: str) -> str:
    reason = check_key_expression(value)
    if reason is not None:
        raise ValueError(reason)
    return value


def _check_topic(
    where: str, topic: _TopicTable, traffic_class: TrafficClass, encodings: Mapping[str, TopicEncoding]
) -> None:
    if topic.pull and not is_key(topic.key):
        raise ConfigError(f"{where}.pull = true: expected a key without wildcards, not {topic.key!r}")
    if topic.pull and (traffic_class.reliable or traffic_class.keep is Keep.CHANGES):
        raise ConfigError(f"{where}.pull = true: expected a class that is not reliable, as the next item is")
    if topic.max_hz is not None and traffic_class.keep is Keep.CHANGES:
        raise ConfigError(
            f'{where}.max_hz = {topic.max_hz:g}: expected none with keep = "changes": only changes cross, '
            "and the last one must not be dropped"
        )
    if topic.entries is not None and traffic_class.keep is not Keep.CHANGES:
        raise ConfigError(f'{where}.entries: expected a class with keep = "changes"')
    if topic.encoding is None:
        return
    if traffic_class.keep is Keep.CHANGES:
        raise ConfigError(
            f'{where}.encoding: expected none with keep = "changes": a shared state crosses as differences'
        )
    if topic.compression is not Compression.RAW:
        raise ConfigError(f"{where}.compression: expected none beside an encoding, which packs by itself")
    if topic.encoding not in encodings:
        known = ", ".join(encodings) or "there is no such table"
        raise ConfigError(
            f"{where}.encoding = {json.dumps(topic.encoding)}: expected one of [encodings]: {known}"
        )
    is_stream = isinstance(encodings[topic.encoding], StreamEncoding)
    if is_stream and (traffic_class.keep is not Keep.LATEST or topic.pull):
        raise ConfigError(
            f'{where}.encoding = {json.dumps(topic.encoding)}: expected a class with keep = "latest" and no'
            " pull, since its messages lean on those that have arrived"
        )


def _check_protection(link: _LinkTable, path: Path) -> None:
    if not link.open:
        return
    if link.keys:
        raise ConfigError(f"{path}: link.open = true: expected no link.keys beside it")
    for name, address in (("listen", link.listen), ("peer", link.peer)):
        if not is_loopback(parse_address(address)[0]):
            raise ConfigError(
                f"{path}: link.open = true with link.{name} = {address!r}: an open link is for loopback "
                "only; make a key with `straitlink keygen` and name it in link.keys"
            )


def _journal(link: _LinkTable, path: Path) -> Path | None:
    """Beside the configuration unless said otherwise. An open link has none: its peer may be anybody."""
    if link.open and link.journal not in (None, JOURNAL_OFF):
        raise ConfigError(f"{path}: link.journal = {link.journal!r}: expected none with link.open = true")
    if link.open or not link.keys or link.journal == JOURNAL_OFF:
        return None
    return path.parent / (link.journal or f"{path.stem}.journal")


def is_loopback(host: str) -> bool:
    """Whether an address never leaves this host."""
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False


def _guaranteed(table: _ShaperTable, path: Path) -> dict[int, float]:
    shares = {int(tier): row.guaranteed_ratio for tier, row in table.tiers.items()}
    if sum(shares.values()) >= 1:
        total = sum(shares.values())
        raise ConfigError(f"{path}: tiers: guaranteed_ratio adds up to {total:g}: expected less than 1")
    return shares


def _from_table(table: _ShaperTable, path: Path) -> ShaperConfig:
    classes = dict(DEFAULT_CLASSES)
    for name, class_table in table.classes.items():
        try:
            classes[name] = class_from_table(name, class_table, classes)
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from error
    encodings = {
        name: build_encoding(f"{path}: encodings.{name}", row, path.parent)
        for name, row in table.encodings.items()
    }
    rules = []
    for index, topic in enumerate(table.topics):
        if topic.traffic_class not in classes:
            known = ", ".join(classes)
            raise ConfigError(
                f"{path}: topics[{index}].class = {topic.traffic_class!r}: expected one of {known}"
            )
        period_ns = 0 if topic.max_hz is None else round(_NS_PER_S / topic.max_hz)
        _check_topic(f"{path}: topics[{index}]", topic, classes[topic.traffic_class], encodings)
        rules.append(
            TopicRule(
                topic.key,
                classes[topic.traffic_class],
                period_ns,
                topic.compression,
                topic.weight,
                None if topic.entries is None else topic.entries.to_entries(),
                topic.pull,
                None if topic.encoding is None else encodings[topic.encoding],
            )
        )
    limits = Limits(
        table.limits.max_topics,
        table.limits.max_message_bytes,
        table.limits.max_reassembly_bytes,
        round(table.limits.max_reassembly_wait_s * _NS_PER_S),
        table.limits.max_unfinished_messages,
        table.limits.max_receipts,
        table.limits.max_journal_messages,
        table.limits.max_journal_bytes,
    )
    link = table.link
    if table.operator_lost is not None and link.side != "robot":
        raise ConfigError(f"{path}: operator_lost: expected on the robot's side only, not the operator's")
    _check_protection(link, path)
    if link.estimator == "presets" and not link.bands:
        raise ConfigError(f'{path}: link.estimator = "presets": expected at least one [[link.bands]]')
    return ShaperConfig(
        side=link.side,
        listen=parse_address(link.listen),
        peer=parse_address(link.peer),
        bus=BusSettings(table.zenoh.listen, table.zenoh.connect, table.zenoh.mode, table.zenoh.config),
        endpoint=EndpointSettings(
            tuple(rules),
            tuple(link.accept),
            link.max_datagram_bytes,
            limits,
            _guaranteed(table, path),
            by_digest(encodings.values()),
        ),
        bands=tuple(
            PresetBand(b.name, b.rate_bps, round(b.one_way_delay_ms * _NS_PER_MS)) for b in link.bands
        ),
        pace_ratio=link.pace_ratio,
        estimator=link.estimator,
        metrics=None if table.metrics is None else parse_address(table.metrics.listen),
        key_files=tuple(path.parent / name for name in link.keys),
        open_link=link.open,
        journal=_journal(link, path),
        operator_lost=None if table.operator_lost is None else table.operator_lost.to_settings(),
        resolved=table.model_dump(mode="json", by_alias=True),
    )

"""The tables of a shaper's TOML file, each value with its bounds; and what is said of a wrong one."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from shaper.address import parse_address
from shaper.carousel_config import CarouselTable, CarouselTopicTable
from shaper.encodings import EncodingTable
from shaper.incoming import Limits
from shaper.key_expression import check_key_expression, is_key
from shaper.operator_lost import OperatorLostSettings
from shaper.traffic_class import Compression, Entries, Keep

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


class TierTable(_Table):
    """[tiers.N]."""

    guaranteed_ratio: Annotated[float, Field(gt=0, lt=1)]


class EntriesTable(_Table):
    """[topics.entries]: which field of a shared state is a list, and by what its entries are known."""

    field: Annotated[int, Field(ge=1, le=536_870_911)]
    key: Annotated[int, Field(ge=1, le=536_870_911)]
    ignored: list[int] = []
    ignored_outside: list[int] = []

    def to_entries(self) -> Entries:
        return Entries(self.field, self.key, frozenset(self.ignored), frozenset(self.ignored_outside))


class TopicTable(_Table):
    """[[topics]]."""

    key: str
    traffic_class: str = Field(alias="class")
    max_hz: Annotated[float, Field(ge=1e-6, le=100_000, allow_inf_nan=False)] | None = None
    compression: Compression = Compression.RAW
    weight: Annotated[float, Field(ge=0.001, le=1000)] = 1.0
    entries: EntriesTable | None = None
    pull: bool = False
    encoding: str | None = None

    @field_validator("key")
    @classmethod
    def _is_key_expression(cls, value: str) -> str:
        return _checked_expression(value)


class BandTable(_Table):
    """[[link.bands]]: a band that the link is said to have."""

    name: str
    rate_bps: Annotated[int, Field(ge=1000, le=10_000_000_000)]
    one_way_delay_ms: Annotated[float, Field(ge=0, le=60_000, allow_inf_nan=False)]


class LinkTable(_Table):
    """[link]."""

    side: Literal["robot", "operator"]
    listen: str
    peer: str
    max_datagram_bytes: Annotated[int, Field(ge=300, le=1472)] = 1472
    pace_ratio: Annotated[float, Field(gt=0, le=1)] = 0.95
    estimator: Literal["presets", "adaptive"] = "adaptive"
    bands: list[BandTable] = []
    accept: list[str] = ["**"]
    keys: list[str] = []
    open: bool = False
    journal: Annotated[str, Field(min_length=1)] | None = None
    predict: bool = False

    @field_validator("listen", "peer")
    @classmethod
    def _is_address(cls, value: str) -> str:
        parse_address(value)
        return value

    @field_validator("accept")
    @classmethod
    def _are_key_expressions(cls, values: list[str]) -> list[str]:
        return [_checked_expression(value) for value in values]


class ZenohTable(_Table):
    """[zenoh]: the local bus."""

    mode: Literal["peer", "client", "router"] | None = None
    listen: list[str] = []
    connect: list[str] = []
    config: dict[str, Any] = {}


class LimitsTable(_Table):
    """[limits]: what a peer can make us hold."""

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

    def to_limits(self) -> Limits:
        return Limits(
            self.max_topics,
            self.max_message_bytes,
            self.max_reassembly_bytes,
            round(self.max_reassembly_wait_s * _NS_PER_S),
            self.max_unfinished_messages,
            self.max_receipts,
            self.max_journal_messages,
            self.max_journal_bytes,
        )


class MetricsTable(_Table):
    """[metrics]."""

    listen: str

    @field_validator("listen")
    @classmethod
    def _is_address(cls, value: str) -> str:
        parse_address(value)
        return value


class OperatorLostTable(_Table):
    """[operator_lost]: what the robot does when nobody is heard."""

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


class ShaperTable(_Table):
    """The whole file."""

    link: LinkTable
    zenoh: ZenohTable
    classes: dict[str, ClassTable] = {}
    tiers: dict[
        Annotated[str, Field(pattern=r"^(0|[1-9][0-9]?|1[0-9]{2}|2[0-4][0-9]|25[0-5])$")], TierTable
    ] = {}
    metrics: MetricsTable | None = None
    operator_lost: OperatorLostTable | None = None
    topics: Annotated[list[TopicTable], Field(min_length=1)]
    limits: LimitsTable = LimitsTable()
    encodings: dict[str, EncodingTable] = {}
    carousel: CarouselTable | None = None


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
            known = _known_keys(problem["loc"], root or ShaperTable, TABLES if tables is None else tables)
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
    table, within = root, ""
    for part in loc[:-1]:
        if table not in (ClassTable, EncodingTable) and not isinstance(part, int):
            table, within = tables.get(f"{within}.{part}", tables.get(part, table)), part
    return ", ".join(f.alias or name for name, f in table.model_fields.items())


TABLES: dict[str, type[BaseModel]] = {
    "link": LinkTable,
    "bands": BandTable,
    "zenoh": ZenohTable,
    "classes": ClassTable,
    "topics": TopicTable,
    "limits": LimitsTable,
    "tiers": TierTable,
    "entries": EntriesTable,
    "metrics": MetricsTable,
    "operator_lost": OperatorLostTable,
    "encodings": EncodingTable,
    "carousel": CarouselTable,
    "carousel.topics": CarouselTopicTable,
}


def _checked_expression(value: str) -> str:
    reason = check_key_expression(value)
    if reason is not None:
        raise ValueError(reason)
    return value

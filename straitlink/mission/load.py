"""The traffic of a mission: named loads, and loads from TOML."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AliasChoices, BaseModel, ConfigDict, Field, ValidationError

from shaper.config import class_from_table
from shaper.config_tables import ClassTable, describe_validation_error
from shaper.errors import ConfigError
from shaper.key_expression import check_key_expression, is_key
from shaper.traffic_class import DEFAULT_CLASSES, Compression, TopicRule, TrafficClass
from straitlink.mission.named_loads import NAMED_LOADS

_NS_PER_S = 1_000_000_000
LOCAL_ONLY = "none"  # class of a topic that is published but that no rule sends
CAROUSEL = "carousel"  # of one that crosses by the mission's second link, if it has one


@dataclass(frozen=True, slots=True)
class LoadTopic:
    """One periodic source. traffic_class: None for a topic that stays on its own bus, or goes_round.

    starts_at_ns: since the mission's start; nothing is published before.
    """

    key: str
    direction: Literal["down", "up"]
    payload_bytes: int
    rate_hz: float
    traffic_class: TrafficClass | None
    max_hz: float | None = None
    goes_round: bool = False
    starts_at_ns: int = 0

    @property
    def is_reliable(self) -> bool:
        """Whether the sender is told what became of each message."""
        return self.traffic_class is not None and self.traffic_class.reliable

    def rule(self) -> TopicRule | None:
        """How the shaper treats it."""
        if self.traffic_class is None:
            return None
        period_ns = 0 if self.max_hz is None else round(_NS_PER_S / self.max_hz)
        return TopicRule(self.key, self.traffic_class, period_ns, Compression.RAW)


@dataclass(frozen=True, slots=True)
class Load:
    """Everything that is published during a mission."""

    name: str
    topics: tuple[LoadTopic, ...]

    def rules(self, direction: Literal["down", "up"]) -> tuple[TopicRule, ...]:
        """The topic rules of the side that sends in this direction."""
        rules = (topic.rule() for topic in self.topics if topic.direction == direction)
        return tuple(rule for rule in rules if rule is not None)


class _TopicTable(BaseModel):
    model_config = ConfigDict(extra="forbid", populate_by_name=True)

    key: str = Field(alias="name", validation_alias=AliasChoices("name", "key", "topic"))
    direction: Literal["down", "up"]
    payload_bytes: Annotated[int, Field(ge=0, le=4_000_000)] = Field(
        alias="bytes", validation_alias=AliasChoices("bytes", "payload_bytes")
    )
    rate_hz: Annotated[float, Field(ge=1e-6, le=100_000, allow_inf_nan=False)]
    traffic_class: str = Field(alias="class", validation_alias=AliasChoices("class", "traffic_class"))
    max_hz: Annotated[float, Field(ge=1e-6, le=100_000, allow_inf_nan=False)] | None = None


class _LoadTable(BaseModel):
    model_config = ConfigDict(extra="forbid")

    name: str = ""
    classes: dict[str, ClassTable] = Field(default_factory=dict)
    topics: Annotated[list[_TopicTable], Field(min_length=1)]


def load_named_or_file(name_or_path: str) -> Load:
    """A named load, or one from a TOML file. Raises ConfigError."""
    rows = NAMED_LOADS.get(name_or_path)
    if rows is not None:
        return _load(name_or_path, [_TopicTable.model_validate(row) for row in rows], DEFAULT_CLASSES)
    path = Path(name_or_path)
    if path.suffix != ".toml":
        names = ", ".join(NAMED_LOADS)
        raise ConfigError(f"load {name_or_path!r} is neither one of {names} nor a .toml file")
    try:
        table = _LoadTable.model_validate(tomllib.loads(path.read_text()))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{path}: is not TOML: {error}") from error
    except ValidationError as error:
        tables: dict[str, type[BaseModel]] = {"topics": _TopicTable, "classes": ClassTable}
        raise ConfigError(describe_validation_error(path, error, _LoadTable, tables)) from error
    classes = dict(DEFAULT_CLASSES)
    for name, class_table in table.classes.items():
        try:
            classes[name] = class_from_table(name, class_table, classes)
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from error
    return _load(table.name or path.stem, table.topics, classes, str(path))


def _load(name: str, rows: Sequence[_TopicTable], classes: dict[str, TrafficClass], where: str = "") -> Load:
    topics: list[LoadTopic] = []
    for index, row in enumerate(rows):
        field = f"{where or name}: topics[{index}]"
        if not is_key(row.key):
            reason = check_key_expression(row.key) or "a source publishes on one key, without wildcards"
            raise ConfigError(f"{field}.name = {row.key!r}: {reason}")
        if any(topic.key == row.key for topic in topics):
            raise ConfigError(f"{field}.name = {row.key!r} stands twice in the load")
        goes_round = row.traffic_class == CAROUSEL
        if goes_round and row.direction != "down":
            raise ConfigError(f"{field}.class = {CAROUSEL!r}: expected direction down: nothing goes back")
        if row.traffic_class not in (LOCAL_ONLY, CAROUSEL) and row.traffic_class not in classes:
            known = ", ".join((*classes, LOCAL_ONLY, CAROUSEL))
            raise ConfigError(f"{field}.class = {row.traffic_class!r}: expected one of {known}")
        traffic_class = classes.get(row.traffic_class)
        topics.append(
            LoadTopic(
                row.key,
                row.direction,
                row.payload_bytes,
                row.rate_hz,
                traffic_class,
                row.max_hz,
                goes_round,
            )
        )
    return Load(name, tuple(topics))

"""[carousel] of a configuration: a second link, from the robot to the operator only, at a fixed rate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator

from shaper.address import parse_address
from shaper.carousel import CarouselSettings, CarouselTopic
from shaper.errors import ConfigError
from shaper.handshake import Side
from shaper.key_expression import check_key_expression

_NS_PER_MS = 1_000_000
_NS_PER_S = 1_000_000_000
_MOST_HELD_BYTES = 1_000_000_000


class CarouselTopicTable(BaseModel):
    """[[carousel.topics]]: what goes round; it does not cross the two-way link."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    key: str
    keep: Literal["latest", "all"] = "latest"
    ttl_ms: Annotated[float, Field(gt=0, le=86_400_000, allow_inf_nan=False)] = 60_000
    max_hz: Annotated[float, Field(ge=1e-6, le=100_000, allow_inf_nan=False)] | None = None

    @field_validator("key")
    @classmethod
    def _is_key_expression(cls, value: str) -> str:
        reason = check_key_expression(value)
        if reason is not None:
            raise ValueError(reason)
        return value

    def to_topic(self) -> CarouselTopic:
        period_ns = 0 if self.max_hz is None else round(_NS_PER_S / self.max_hz)
        return CarouselTopic(self.key, self.keep == "latest", round(self.ttl_ms * _NS_PER_MS), period_ns)


class CarouselTable(BaseModel):
    """[carousel]: listen on the operator's side, all else on the robot's."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    listen: str | None = None
    peer: str | None = None
    rate_bps: Annotated[int, Field(ge=10_000, le=10_000_000_000)] | None = None
    repeat_s: Annotated[float, Field(ge=0.05, le=60, allow_inf_nan=False)] = 0.5
    max_datagram_bytes: Annotated[int, Field(ge=300, le=1472)] = 1472
    topics: list[CarouselTopicTable] = []

    @field_validator("listen", "peer")
    @classmethod
    def _is_address(cls, value: str) -> str:
        parse_address(value)
        return value


@dataclass(frozen=True, slots=True)
class CarouselConfig:
    """address: where the robot sends to, or the operator listens. settings: the robot's."""

    address: tuple[str, int]
    settings: CarouselSettings | None = None


def carousel_config(table: CarouselTable, side: Side, where: str) -> CarouselConfig:
    """A side's half of a carousel. where: the file, for messages. Raises ConfigError."""
    if side == "operator":
        for name in ("peer", "rate_bps", "topics"):
            if getattr(table, name):
                raise ConfigError(f"{where}: carousel.{name}: expected on the robot's side only: it sends")
        if table.listen is None:
            raise ConfigError(
                f"{where}: carousel.listen: is missing: expected where it comes in, as host:port"
            )
        return CarouselConfig(parse_address(table.listen))
    if table.listen is not None:
        raise ConfigError(f"{where}: carousel.listen: expected on the operator's side: nothing comes back")
    if table.peer is None or table.rate_bps is None or not table.topics:
        missing = [n for n in ("peer", "rate_bps", "topics") if not getattr(table, n)]
        raise ConfigError(
            f"{where}: carousel.{missing[0]}: is missing: expected the operator's address (peer), a rate "
            "that the link carries (rate_bps; nothing is measured) and [[carousel.topics]]"
        )
    topics = tuple(topic.to_topic() for topic in table.topics)
    settings = CarouselSettings(
        topics, table.rate_bps, round(table.repeat_s * _NS_PER_S), table.max_datagram_bytes
    )
    if not 4 * table.max_datagram_bytes <= settings.held_bytes <= _MOST_HELD_BYTES:
        raise ConfigError(
            f"{where}: carousel.repeat_s = {table.repeat_s:g} at rate_bps = {table.rate_bps}: "
            f"{settings.held_bytes} bytes would go round: expected {4 * table.max_datagram_bytes} to "
            f"{_MOST_HELD_BYTES}"
        )
    return CarouselConfig(parse_address(table.peer), settings)

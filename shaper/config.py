"""A shaper's configuration: TOML, checked once here, turned into the values that the core counts with."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import ValidationError

from messages.payload import StreamEncoding, TopicEncoding
from shaper.address import is_loopback, parse_address
from shaper.bus import BusSettings
from shaper.carousel_config import CarouselConfig, carousel_config
from shaper.config_tables import (
    ClassTable,
    LinkTable,
    ShaperTable,
    TopicTable,
    describe_validation_error,
)
from shaper.encodings import build_encoding
from shaper.endpoint_settings import EndpointSettings
from shaper.errors import ConfigError
from shaper.key_expression import is_key
from shaper.link_estimator import PresetBand
from shaper.operator_lost import OperatorLostSettings
from shaper.traffic_class import DEFAULT_CLASSES, Compression, Keep, TopicRule, TrafficClass
from shaper.wire_type import by_digest

JOURNAL_OFF = "off"
_NS_PER_MS = 1_000_000
_NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True)
class ShaperConfig:
    """Everything that `straitlink shaper` runs on.

    listen, peer: UDP (host, port) of this side and of the other. metrics: where Prometheus may ask.
    key_files: of link keys, the first to start with. open_link: no keys are wanted, loopback only.
    journal: where reliable messages are on record; None for nowhere. operator_lost: robot's side only.
    carousel: a second link without a way back. predict: slow before falls that come at regular times.
    resolved: the configuration with all defaults filled in, to be saved beside a result.
    """

    side: Literal["robot", "operator"]
    listen: tuple[str, int]
    peer: tuple[str, int]
    bus: BusSettings
    endpoint: EndpointSettings
    bands: tuple[PresetBand, ...]
    pace_ratio: float
    estimator: Literal["presets", "adaptive"] = "adaptive"
    predict: bool = False
    metrics: tuple[str, int] | None = None
    key_files: tuple[Path, ...] = ()
    open_link: bool = False
    journal: Path | None = None
    operator_lost: OperatorLostSettings | None = None
    carousel: CarouselConfig | None = None
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
        table = ShaperTable.model_validate(values)
    except ValidationError as error:
        raise ConfigError(describe_validation_error(path, error)) from error
    return _from_table(table, path)


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


def _check_topic(
    where: str, topic: TopicTable, traffic_class: TrafficClass, encodings: Mapping[str, TopicEncoding]
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


def _check_protection(link: LinkTable, carousel: CarouselConfig | None, path: Path) -> None:
    if not link.open:
        return
    if link.keys:
        raise ConfigError(f"{path}: link.open = true: expected no link.keys beside it")
    addresses = {"link.listen": parse_address(link.listen), "link.peer": parse_address(link.peer)}
    if carousel is not None:
        addresses["carousel.listen" if link.side == "operator" else "carousel.peer"] = carousel.address
    for name, (host, port) in addresses.items():
        if not is_loopback(host):
            raise ConfigError(
                f"{path}: link.open = true with {name} = '{host}:{port}': an open link is for loopback "
                "only; make a key with `straitlink keygen` and name it in link.keys"
            )


def _journal(link: LinkTable, path: Path) -> Path | None:
    """Beside the configuration unless said otherwise. An open link has none: its peer may be anybody."""
    if link.open and link.journal not in (None, JOURNAL_OFF):
        raise ConfigError(f"{path}: link.journal = {link.journal!r}: expected none with link.open = true")
    if link.open or not link.keys or link.journal == JOURNAL_OFF:
        return None
    return path.parent / (link.journal or f"{path.stem}.journal")


def _guaranteed(table: ShaperTable, path: Path) -> dict[int, float]:
    shares = {int(tier): row.guaranteed_ratio for tier, row in table.tiers.items()}
    if sum(shares.values()) >= 1:
        total = sum(shares.values())
        raise ConfigError(f"{path}: tiers: guaranteed_ratio adds up to {total:g}: expected less than 1")
    return shares


def _classes(table: ShaperTable, path: Path) -> dict[str, TrafficClass]:
    classes = dict(DEFAULT_CLASSES)
    for name, class_table in table.classes.items():
        try:
            classes[name] = class_from_table(name, class_table, classes)
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from error
    return classes


def _rule(
    where: str, topic: TopicTable, classes: Mapping[str, TrafficClass], encodings: Mapping[str, TopicEncoding]
) -> TopicRule:
    if topic.traffic_class not in classes:
        known = ", ".join(classes)
        raise ConfigError(f"{where}.class = {topic.traffic_class!r}: expected one of {known}")
    _check_topic(where, topic, classes[topic.traffic_class], encodings)
    return TopicRule(
        topic.key,
        classes[topic.traffic_class],
        0 if topic.max_hz is None else round(_NS_PER_S / topic.max_hz),
        topic.compression,
        topic.weight,
        None if topic.entries is None else topic.entries.to_entries(),
        topic.pull,
        None if topic.encoding is None else encodings[topic.encoding],
    )


def _endpoint_settings(table: ShaperTable, path: Path) -> EndpointSettings:
    classes = _classes(table, path)
    encodings = {
        name: build_encoding(f"{path}: encodings.{name}", row, path.parent)
        for name, row in table.encodings.items()
    }
    rules = tuple(
        _rule(f"{path}: topics[{index}]", topic, classes, encodings)
        for index, topic in enumerate(table.topics)
    )
    return EndpointSettings(
        rules,
        tuple(table.link.accept),
        table.link.max_datagram_bytes,
        table.limits.to_limits(),
        _guaranteed(table, path),
        by_digest(encodings.values()),
    )


def _from_table(table: ShaperTable, path: Path) -> ShaperConfig:
    link = table.link
    endpoint = _endpoint_settings(table, path)
    if table.operator_lost is not None and link.side != "robot":
        raise ConfigError(f"{path}: operator_lost: expected on the robot's side only, not the operator's")
    carousel = None if table.carousel is None else carousel_config(table.carousel, link.side, str(path))
    _check_protection(link, carousel, path)
    if link.predict and link.estimator == "presets":
        raise ConfigError(f'{path}: link.predict = true: expected link.estimator = "adaptive" with it')
    if link.estimator == "presets" and not link.bands:
        raise ConfigError(f'{path}: link.estimator = "presets": expected at least one [[link.bands]]')
    return ShaperConfig(
        side=link.side,
        listen=parse_address(link.listen),
        peer=parse_address(link.peer),
        bus=BusSettings(table.zenoh.listen, table.zenoh.connect, table.zenoh.mode, table.zenoh.config),
        endpoint=endpoint,
        bands=tuple(
            PresetBand(b.name, b.rate_bps, round(b.one_way_delay_ms * _NS_PER_MS)) for b in link.bands
        ),
        pace_ratio=link.pace_ratio,
        estimator=link.estimator,
        predict=link.predict,
        metrics=None if table.metrics is None else parse_address(table.metrics.listen),
        key_files=tuple(path.parent / name for name in link.keys),
        open_link=link.open,
        journal=_journal(link, path),
        carousel=carousel,
        operator_lost=None if table.operator_lost is None else table.operator_lost.to_settings(),
        resolved=table.model_dump(mode="json", by_alias=True),
    )

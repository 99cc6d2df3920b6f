"""The shapers' configurations of a demonstration: the examples, or the user's own, moved to free ports."""

from __future__ import annotations

import secrets
import socket
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import tomlkit

from netem_scripts.band import Profile
from shaper.config import load_config
from shaper.key_file import write_key_file
from shaper.link_key import make_link_key
from straitlink.demo.errors import DemoError
from straitlink.demo.log_topics import LogTopic
from straitlink.mission.mission import preset_bands

_NS_PER_MS = 1_000_000
KEY_FILE = "link.key"
_SMALL_BYTES = 2048  # up to this a message is state, beyond it is perception


@dataclass(frozen=True, slots=True)
class Addresses:
    """Loopback ports, all free a moment ago. UDP: shaper <-> link; TCP: the two buses."""

    robot_shaper: str
    operator_shaper: str
    link_robot: str
    link_operator: str
    robot_bus: str
    operator_bus: str


@dataclass(frozen=True, slots=True)
class OwnConfigs:
    """Shaper configurations in place of the examples."""

    robot: Path | None = None
    operator: Path | None = None


def free_addresses() -> Addresses:
    """Ports that nobody uses, found by asking the kernel."""
    kinds = [socket.SOCK_DGRAM] * 4 + [socket.SOCK_STREAM] * 2
    sockets = [socket.socket(socket.AF_INET, kind) for kind in kinds]
    try:
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        names = [f"127.0.0.1:{each.getsockname()[1]}" for each in sockets]
    finally:
        for each in sockets:
            each.close()
    return Addresses(*names[:4], *(f"tcp/{name}" for name in names[4:]))


def write_configs(
    folder: Path,
    addresses: Addresses,
    profile: Profile,
    log_topics: tuple[LogTopic, ...] | None,
    own: OwnConfigs | None = None,
) -> None:
    """Write robot.toml, operator.toml, perception.toml and a key of their own for this once.

    log_topics: of a foreign log, None for the synthetic one. own: as `check_configs` has found them good.
    """
    own = own or OwnConfigs()
    robot, operator = _own_or_example(own.robot, "robot"), _own_or_example(own.operator, "operator")
    perception = _example("perception")
    perception["zenoh"]["connect"] = [addresses.robot_bus]
    (folder / "perception.toml").write_text(tomlkit.dumps(perception))
    _move(robot, addresses.robot_shaper, addresses.link_robot, addresses.robot_bus)
    _move(operator, addresses.operator_shaper, addresses.link_operator, addresses.operator_bus)
    _set_bands(robot, profile, "down")
    _set_bands(operator, profile, "up")
    if log_topics is not None:
        if own.robot is None:
            robot["topics"] = _rules(log_topics)
        operator["link"]["accept"] = ["**"]
    write_temporary_key(folder)
    for side, document in (("robot", robot), ("operator", operator)):
        for name in ("open", "journal"):
            document["link"].pop(name, None)
        document["link"]["keys"] = [KEY_FILE]
        (folder / f"{side}.toml").write_text(tomlkit.dumps(document))


def write_temporary_key(folder: Path) -> None:
    """A key file for two shapers whose configurations lie in the same folder, in place of an older one."""
    path = folder / KEY_FILE
    path.unlink(missing_ok=True)
    write_key_file(path, make_link_key(secrets.token_bytes))


def check_configs(own: OwnConfigs) -> None:
    """Raises ConfigError or DemoError for one that no shaper, or no demonstration, can take."""
    for side, path in (("robot", own.robot), ("operator", own.operator)):
        if path is None:
            continue
        config = load_config(path)
        if config.side != side:
            raise DemoError(f"{path}: link.side = {config.side!r}: expected {side!r}")
        if config.carousel is not None:
            raise DemoError(f"{path}: carousel: expected none, as the demonstration's link has a way back")


def _own_or_example(path: Path | None, side: str) -> Any:
    if path is None:
        return _example(side)
    document = tomlkit.parse(path.read_text())
    for encoding in document.get("encodings", {}).values():
        for name in {"proto", "dictionary"} & set(encoding):
            encoding[name] = str((path.parent / encoding[name]).resolve())
    return document


def _example(side: str) -> Any:
    return tomlkit.parse((files("straitlink.demo") / f"{side}.toml").read_text())


def _move(document: Any, listen: str, peer: str, bus: str) -> None:
    document["link"]["listen"] = listen
    document["link"]["peer"] = peer
    document["zenoh"] = {"connect": [bus]}


def _set_bands(document: Any, profile: Profile, sends: Any) -> None:
    bands = tomlkit.aot()
    for preset in preset_bands(profile, sends):
        band = tomlkit.table()
        band["name"] = preset.name
        band["rate_bps"] = preset.rate_bps
        band["one_way_delay_ms"] = preset.one_way_delay_ns / _NS_PER_MS
        bands.append(band)
    document["link"]["bands"] = bands


def _rules(topics: tuple[LogTopic, ...]) -> Any:
    """Rules for a log that nobody has described: small messages are state, large ones perception."""
    rules = tomlkit.aot()
    for topic in topics:
        rule = tomlkit.table()
        rule.add(tomlkit.comment(f"{topic.mean_bytes} B at {topic.rate_hz:.1f} Hz in the log"))
        rule["key"] = topic.key
        small = topic.mean_bytes <= _SMALL_BYTES
        rule["class"] = "state" if small else "perception"
        rule["max_hz"] = 5 if small else 2
        rule["compression"] = "zstd"
        rules.append(rule)
    return rules

"""What a log holds, as far as the demonstration must know to shape it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mcap.exceptions import McapError
from mcap.reader import make_reader

from straitlink.demo.errors import DemoError
from straitlink.replay import ReplayError, topic_key

_NS_PER_S = 1_000_000_000
_LOOK_AT_NS = 20 * _NS_PER_S  # of log time: enough to know sizes and rates


@dataclass(frozen=True, slots=True)
class LogTopic:
    """One topic of a log: mean payload size and rate over its first seconds."""

    topic: str
    key: str
    mean_bytes: int
    rate_hz: float


def read_log_topics(log: Path) -> tuple[tuple[LogTopic, ...], tuple[str, ...]]:
    """The topics of a log that can be keys, and those that cannot. Raises DemoError."""
    sizes: dict[str, list[int]] = {}
    first_ns = last_ns = 0
    try:
        with log.open("rb") as stream:
            for _schema, channel, message in make_reader(stream).iter_messages():
                first_ns = first_ns or message.log_time
                last_ns = message.log_time
                if last_ns - first_ns > _LOOK_AT_NS:
                    break
                sizes.setdefault(channel.topic, []).append(len(message.data))
    except OSError as error:
        raise DemoError(f"{log}: cannot be read: {error.strerror}") from error
    except McapError as error:
        raise DemoError(f"{log}: is not an MCAP file: {error}") from error
    if not sizes:
        raise DemoError(f"{log}: holds no messages")
    seconds = max(1.0, (last_ns - first_ns) / _NS_PER_S)
    topics, unusable = [], []
    for topic, each in sizes.items():
        try:
            key = topic_key(topic)
        except ReplayError:
            unusable.append(topic)
            continue
        topics.append(LogTopic(topic, key, sum(each) // len(each), len(each) / seconds))
    return tuple(topics), tuple(unusable)

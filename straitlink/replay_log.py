"""The log that a replay publishes: opened, its topics as Zenoh keys, its part in time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from mcap.exceptions import McapError
from mcap.reader import McapReader, make_reader
from mcap.records import Channel
from mcap.summary import Summary

from .recording import is_mcap
from .replay_timing import NS_PER_S
from .schemas import ZENOH_ENCODING_KEY, PayloadType, zenoh_encoding


class ReplayError(Exception):
    """The log cannot be replayed; the message says which file or topic and what to do."""


@contextmanager
def open_log(path: Path) -> Iterator[tuple[McapReader, Summary]]:
    """A finished log with at least one message: its reader and its summary, which has statistics.

    Raises ReplayError for anything else.
    """
    try:
        stream: IO[bytes] = path.open("rb")
    except OSError as error:
        raise ReplayError(f"cannot open the log {path}: {error.strerror}") from error
    with stream:
        if not is_mcap(stream):
            raise ReplayError(f"{path} is not an MCAP file")
        try:
            reader = make_reader(stream)
            summary = reader.get_summary()
        except (McapError, OSError, ValueError) as error:
            raise ReplayError(f"{path} is not a finished MCAP file ({error}); recover it first") from error
        if summary is None or summary.statistics is None or not summary.statistics.message_count:
            raise ReplayError(f"{path} has no messages, or no summary section that counts them")
        yield reader, summary


def selected_time(summary: Summary, start_s: float, end_s: float | None) -> tuple[int, int]:
    """Log times [start, end) of the part to publish.

    Counted from the log's first message whatever topics are selected, so that two replays of one
    log, one per direction, stay in step.
    """
    assert summary.statistics is not None  # open_log checked
    first_ns, last_ns = summary.statistics.message_start_time, summary.statistics.message_end_time
    start_ns = first_ns + round(start_s * NS_PER_S)
    end_ns = last_ns + 1
    if end_s is not None:
        end_ns = min(end_ns, first_ns + round(end_s * NS_PER_S))
    if start_ns >= end_ns:
        length_s = (last_ns - first_ns) / NS_PER_S
        raise ReplayError(f"replay start_s = {start_s} is past the log's end at {length_s:.3f} s")
    return start_ns, end_ns


def topic_key(topic: str) -> str:
    """The Zenoh key of an MCAP topic: "/robot/scan" -> "robot/scan".

    Raises ReplayError for a topic that cannot be a key.
    """
    key = topic.strip("/")
    if not key or "//" in key or any(sign in key for sign in "*$?#"):
        raise ReplayError(
            f"topic {topic!r} cannot be a Zenoh key (empty chunk or one of * $ ? #): exclude it"
        )
    return key


def channel_encoding(channel: Channel, summary: Summary) -> str:
    """The Zenoh encoding string of an MCAP channel."""
    if ZENOH_ENCODING_KEY in channel.metadata:
        return channel.metadata[ZENOH_ENCODING_KEY]
    schema = summary.schemas.get(channel.schema_id)
    return zenoh_encoding(PayloadType(channel.message_encoding, schema.name if schema else ""))

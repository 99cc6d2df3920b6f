"""Dictionaries from a log: one for each topic whose messages they make smaller."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from messages.payload.training import Trained, train
from straitlink.replay_log import open_log, topic_key

MAX_MESSAGES = 2000  # of a topic, evenly over the log
MAX_MESSAGE_BYTES = 100_000  # what is larger (pictures, clouds) has no use for a dictionary
WORTH_RATIO = 0.05  # of plain zstd's bytes: less is not worth a file on both sides


@dataclass(frozen=True, slots=True)
class TopicDictionary:
    """One topic's result. file: where the dictionary is; None if it is not worth one."""

    key: str
    trained: Trained
    file: Path | None


def train_dictionaries(log: Path, folder: Path, max_dictionary_bytes: int) -> Iterator[TopicDictionary]:
    """Train on every topic of a finished MCAP log; write the dictionaries that are worth it to `folder`.

    Raises ReplayError for a log that is none.
    """
    for key, messages in sorted(_messages(log).items()):
        trained = train(messages, max_dictionary_bytes)
        file = None
        if trained.dictionary and trained.gain_ratio >= WORTH_RATIO:
            folder.mkdir(parents=True, exist_ok=True)
            file = folder / f"{key.replace('/', '.')}.zdict"
            file.write_bytes(trained.dictionary)
        yield TopicDictionary(key, trained, file)


def config_snippet(results: list[TopicDictionary], folder: Path) -> str:
    """What to write into both shapers' configurations, and into the topics of the one that sends."""
    lines = []
    for result in results:
        if result.file is not None:
            name = result.key.replace("/", "_")
            path = result.file.relative_to(folder.parent) if folder.parent != folder else result.file
            lines += [f"[encodings.{name}]", f'dictionary = "{path}"', ""]
    return "\n".join(lines)


def _messages(log: Path) -> dict[str, list[bytes]]:
    """Small messages by key, at most MAX_MESSAGES of each, evenly over the log."""
    messages: dict[str, list[bytes]] = defaultdict(list)
    too_large: set[str] = set()
    with open_log(log) as (reader, summary):
        assert summary.statistics is not None  # open_log checked
        counts = summary.statistics.channel_message_counts
        strides = {channel_id: -(-count // MAX_MESSAGES) for channel_id, count in counts.items()}
        seen: dict[int, int] = defaultdict(int)
        for _, channel, message in reader.iter_messages():
            number = seen[channel.id]
            seen[channel.id] += 1
            if number % strides[channel.id]:
                continue
            key = topic_key(channel.topic)
            if len(message.data) > MAX_MESSAGE_BYTES:
                too_large.add(key)
                messages.pop(key, None)
            elif key not in too_large:
                messages[key].append(message.data)
    return messages

"""Dictionaries for topics that no schema bounds, and what they gain on messages they have not seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import zstandard

from messages.payload.dictionary import DictionaryEncoding
from messages.payload.topic_encoding import Payload

HELD_OUT_RATIO = 0.2  # the end of a log: neighbours in time are too alike to judge by
LEAST_MESSAGES = 20
_PLAIN_LEVEL = 6  # what `compression = "zstd"` uses
_COVER_SEGMENT, _COVER_WORD = 200, 8  # fixed, so that training takes one pass and gives the same bytes


@dataclass(frozen=True, slots=True)
class Trained:
    """A topic's dictionary and the mean sizes, bytes, of the messages that it was not trained on.

    dictionary: empty where the messages are too few or too small to train on.
    """

    dictionary: bytes
    trained_on: int
    held_out: int
    raw_bytes: float
    zstd_bytes: float
    dictionary_bytes: float

    @property
    def gain_ratio(self) -> float:
        """Share of what plain zstd sends that the dictionary saves; below 0 where it costs."""
        return 1 - self.dictionary_bytes / self.zstd_bytes if self.zstd_bytes else 0.0


def train(messages: Sequence[bytes], max_dictionary_bytes: int) -> Trained:
    """Train on the first messages of a topic, in order of time, and judge by the last fifth."""
    split = len(messages) - max(1, round(len(messages) * HELD_OUT_RATIO))
    seen, unseen = messages[:split], messages[split:]
    raw_bytes = _mean([len(message) for message in unseen])
    plain = zstandard.ZstdCompressor(level=_PLAIN_LEVEL)
    zstd_bytes = _mean([min(len(plain.compress(message)), len(message)) for message in unseen])
    dictionary = _dictionary(seen, max_dictionary_bytes) if len(messages) >= LEAST_MESSAGES else b""
    if not dictionary:
        return Trained(b"", len(seen), len(unseen), raw_bytes, zstd_bytes, zstd_bytes)
    encoding = DictionaryEncoding(dictionary)
    sizes = [len(encoding.encode(Payload(message, "")).data) for message in unseen]
    return Trained(dictionary, len(seen), len(unseen), raw_bytes, zstd_bytes, _mean(sizes))


def _dictionary(samples: Sequence[bytes], max_bytes: int) -> bytes:
    whole: list[bytes | bytearray | memoryview[int]] = [
        sample for sample in samples if len(sample) >= _COVER_WORD
    ]
    size = min(max_bytes, max(1024, sum(map(len, whole)) // 4))  # more would be the samples themselves
    try:
        trained = zstandard.train_dictionary(size, whole, k=_COVER_SEGMENT, d=_COVER_WORD)
    except zstandard.ZstdError:  # too few or too small samples, in zstd's judgement
        return b""
    return bytes(trained.as_bytes())


def _mean(sizes: Sequence[int]) -> float:
    return sum(sizes) / len(sizes) if sizes else 0.0

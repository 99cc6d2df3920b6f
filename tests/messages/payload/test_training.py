"""A dictionary is judged by messages that it has not seen, and is not made where it cannot help."""

from __future__ import annotations

import random

from messages.payload import Payload
from messages.payload.dictionary import DictionaryEncoding
from messages.payload.training import LEAST_MESSAGES, train

NAMES = [f"left_arm_joint_{i}" for i in range(12)]


def states(count: int) -> list[bytes]:
    draws = random.Random(7)
    return [
        ",".join(f'{{"name":"{name}","position":{draws.uniform(-1, 1):.3f}}}' for name in NAMES).encode()
        for _ in range(count)
    ]


def test_what_repeats_from_message_to_message_is_gained_on_later_messages() -> None:
    messages = states(300)
    trained = train(messages, 8000)
    assert (trained.trained_on, trained.held_out) == (240, 60)
    assert trained.gain_ratio > 0.4
    assert 0 < len(trained.dictionary) <= 8000
    encoding = DictionaryEncoding(trained.dictionary)
    sizes = [len(encoding.encode(Payload(message, "")).data) for message in messages[240:]]
    assert trained.dictionary_bytes == sum(sizes) / 60


def test_the_same_log_makes_the_same_dictionary() -> None:
    assert train(states(100), 4000).dictionary == train(states(100), 4000).dictionary


def test_noise_gains_nothing_and_says_so() -> None:
    draws = random.Random(1)
    assert train([draws.randbytes(300) for _ in range(100)], 4000).gain_ratio < 0.02


def test_too_few_or_too_small_messages_make_no_dictionary() -> None:
    for messages in (states(LEAST_MESSAGES - 1), [b"ab"] * 100, [b""] * 50, states(1)):
        trained = train(messages, 4000)
        assert (trained.dictionary, trained.gain_ratio) == (b"", 0.0)
        assert trained.dictionary_bytes == trained.zstd_bytes

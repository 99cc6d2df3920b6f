"""What any peer may send to the decoders of views: refused or decoded, within 64 MB and a second of CPU."""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from bench.view_fuzz import DECODERS, MOST_BYTES, MOST_S
from bench.view_hostile import (
    Kind,
    changed_bytes,
    cut_or_lengthened,
    noise,
    promises,
    spliced,
    whole_messages,
)
from perception_server.view_codec import DecodeError

MAKERS = (promises, promises, promises, changed_bytes, cut_or_lengthened, spliced, noise)
ROUNDS = 2


@pytest.fixture(scope="module", autouse=True)
def traced() -> Iterator[None]:
    for kind, messages in whole_messages().items():
        for message in messages[:2] + messages[-1:]:
            DECODERS[kind](message)  # what is loaded once is loaded
    tracemalloc.start()
    yield
    tracemalloc.stop()


def refused(decode: Callable[[bytes], object], message: bytes) -> bool:
    try:
        decode(message)
    except DecodeError:
        return True
    return False


@pytest.mark.parametrize("kind", DECODERS)
def test_hostile_bytes_take_little_memory_and_time(kind: Kind) -> None:
    random = np.random.default_rng([20, *kind.encode()])
    whole = whole_messages()[kind]
    decode, refusals = DECODERS[kind], 0
    for maker in MAKERS * ROUNDS:
        message = maker(random, kind, whole)
        if message is None:
            continue
        tracemalloc.reset_peak()
        held, began_s = tracemalloc.get_traced_memory()[0], time.thread_time()
        refusals += refused(decode, message)
        took_s, peak = time.thread_time() - began_s, tracemalloc.get_traced_memory()[1]
        assert peak - held <= MOST_BYTES, (maker.__name__, message[:40].hex())
        assert took_s <= MOST_S, (maker.__name__, message[:40].hex())
    assert refusals > ROUNDS
    assert not any(refused(decode, message) for message in whole[-2:])

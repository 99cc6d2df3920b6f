"""When each topic is sampled, and what a sample is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from google.protobuf.timestamp_pb2 import Timestamp
from numpy.typing import NDArray

from messages.catalogue import CATALOGUE, CatalogueTopic
from straitlink.synthetic.rigid import FloatArray
from straitlink.synthetic.settings import LIGHT_MAX_RATE_HZ, START_NS, SyntheticSettings

_BLOCK_S = 0.5  # samples of a topic worked out at once: what bounds memory
_PHASE_NS = 617_000  # between neighbours in the catalogue, so that not everything falls on one instant


@dataclass(frozen=True, slots=True)
class SyntheticMessage:
    """One sample of one topic.

    key: Zenoh key, no leading slash. schema_name: full protobuf name of the payload's type.
    capture_ns: nanoseconds since the Unix epoch. sequence: counts the topic's samples from 0.
    """

    key: str
    schema_name: str
    payload: bytes
    capture_ns: int
    sequence: int


@dataclass(frozen=True, slots=True)
class Block:
    """A run of consecutive samples: capture_ns and seconds since the start of the log, both (T,)."""

    capture_ns: NDArray[np.int64]
    times_s: FloatArray


def blocks(
    topic: CatalogueTopic, settings: SyntheticSettings, light_max_rate_hz: float = LIGHT_MAX_RATE_HZ
) -> Iterator[Block]:
    """The sampling instants of a topic in [0, duration), in runs of at most half a second.

    light_max_rate_hz: bound on the rate in a light log.
    """
    rate_hz = min(topic.rate_hz, light_max_rate_hz) if settings.light else topic.rate_hz
    period_ns = 1e9 / rate_hz
    phase_ns = (CATALOGUE.index(topic) * _PHASE_NS) % int(period_ns)
    count = int(np.ceil((settings.duration_ns - phase_ns) / period_ns))
    step = max(1, int(_BLOCK_S * rate_hz))
    for first in range(0, count, step):
        index = np.arange(first, min(first + step, count))
        offset_ns = np.round(index * period_ns).astype(np.int64) + phase_ns
        yield Block(offset_ns + START_NS, offset_ns.astype(np.float64) * 1e-9)


def stamp(timestamp: Timestamp, capture_ns: int) -> None:
    """Set a protobuf Timestamp in place."""
    timestamp.seconds, timestamp.nanos = divmod(capture_ns, 1_000_000_000)

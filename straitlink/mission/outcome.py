"""What came of a mission, as the numbers that one asks for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from netem_scripts.band import DirectionProfile

_NS_PER_MS = 1_000_000
_GRID_NS = 10_000_000  # the queue is sampled this often, so its percentiles are weighted by time
SETTLING_NS = 2_000_000_000  # after a band change; a drop of the rate leaves in the buffer what was under way


@dataclass(slots=True)
class TopicOutcome:
    """Ages (capture to delivery, true time) of a topic's messages, beside the ledger's counters."""

    direction: Literal["down", "up"]
    offered: int = 0
    ages_ns: list[int] = field(default_factory=list)
    received_bytes: int = 0

    def on_delivered(self, age_ns: int, payload_bytes: int) -> None:
        self.ages_ns.append(age_ns)
        self.received_bytes += payload_bytes


class QueueSampler:
    """The queueing delay of one direction, on a grid of 10 ms of true time."""

    def __init__(self, direction: DirectionProfile) -> None:
        self._next_ns = 0
        self._empty_at_ns = 0  # when the last bit that is queued will have left
        self._samples_ns: list[int] = []
        self.overflows = 0
        self.losses = 0

    def on_packet(self, now_ns: int, departure_ns: int | None) -> None:
        """A packet entered; departure_ns is None if it was dropped by a full buffer."""
        self.advance(now_ns)
        if departure_ns is not None:
            self._empty_at_ns = departure_ns

    def advance(self, now_ns: int) -> None:
        """Sample up to now."""
        empty_at_ns, samples_ns, at_ns = self._empty_at_ns, self._samples_ns, self._next_ns
        while at_ns < now_ns:
            samples_ns.append(empty_at_ns - at_ns if empty_at_ns > at_ns else 0)
            at_ns += _GRID_NS
        self._next_ns = at_ns

    def samples_ns(self) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
        """All samples; number i was taken at i * 10 ms."""
        return np.array(self._samples_ns, dtype=np.int64)


def percentiles_ms(
    values_ns: Sequence[int] | np.ndarray[tuple[int], np.dtype[np.int64]],
) -> tuple[float | None, ...]:
    """p50, p95 and maximum in milliseconds (nearest rank above, so each is a value that occurred)."""
    if len(values_ns) == 0:
        return (None, None, None)
    ranks = np.percentile(np.asarray(values_ns), [50, 95, 100], method="higher")
    return tuple(round(float(v) / _NS_PER_MS, 3) for v in ranks)


def settled_mask(direction: DirectionProfile, samples: int) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which grid samples lie more than 2 s after a change of band."""
    mask = np.ones(samples, dtype=bool)
    changes_ns, at_ns, index = [], 0, 0
    while at_ns < samples * _GRID_NS:
        if index >= len(direction.bands) and not direction.cyclic:
            break
        at_ns += direction.bands[index % len(direction.bands)].duration_ns
        index += 1
        changes_ns.append(at_ns)
    for change_ns in changes_ns:
        mask[change_ns // _GRID_NS : (change_ns + SETTLING_NS) // _GRID_NS + 1] = False
    return mask


def topic_row(
    outcome: TopicOutcome, sent: Mapping[str, int] | None, expired_there: int, stale: int, unreadable: int = 0
) -> dict[str, object]:
    """One topic of the result. Every offered message is in exactly one of the counters.

    offered = decimated + superseded + expired + overflow + refused + delivered + stale + unreadable + lost
    + in_flight + local
    expired_there: messages that came after their time to live, of which the sender was not told.
    """
    counts = sent or {"decimated": 0, "superseded": 0, "expired": 0, "overflow": 0, "sent": 0}
    p50, p95, maximum = percentiles_ms(outcome.ages_ns)
    delivered = len(outcome.ages_ns)
    queued = int(counts.get("queued", 0))
    return {
        "direction": outcome.direction,
        "offered": outcome.offered,
        "delivered": delivered,
        "superseded": counts["superseded"],
        "expired": counts["expired"] + expired_there,
        "stale": stale,
        "unreadable": unreadable,
        "lost": counts["sent"] - delivered - expired_there - stale - unreadable,
        "decimated": counts["decimated"],
        "overflow": counts["overflow"],
        "refused": counts.get("refused", 0),
        "in_flight": queued,
        "local": 0 if sent else outcome.offered,
        "age_p50_ms": p50,
        "age_p95_ms": p95,
        "age_max_ms": maximum,
        "bytes": outcome.received_bytes,
        "sent_bytes": counts.get("sent_bytes", 0),
        "repeated_bytes": counts.get("repeated_bytes", 0),
    }

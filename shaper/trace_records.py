"""The lines of a shaper's trace, the same from a live daemon and from virtual time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal

from shaper.endpoint import Endpoint
from shaper.events import (
    Delivered,
    EncodingTrouble,
    Event,
    LinkState,
    PeerEstimate,
    PeerStarted,
    Receipt,
    Wanted,
)
from shaper.ledger import SentLedger
from shaper.notices import Notice
from shaper.operator_lost import OperatorBack, OperatorLost

Record = dict[str, object]
Direction = Literal["down", "up"]

BIN_NS = 100_000_000  # sent bytes are summed over this long
LEDGER_INTERVAL_NS = 1_000_000_000


def start_record(side: str, t_ns: int, unix_ns: int) -> Record:
    """First line: the trace's clock (monotonic) and the wall clock at the same instant."""
    return {"event": "start", "t_ns": t_ns, "unix_ns": unix_ns, "side": side}


def event_record(event: Event, t_ns: int) -> Record:
    """One event of the endpoint."""
    match event:
        case Delivered():
            return {
                "event": "delivered",
                "t_ns": t_ns,
                "topic": event.key,
                "number": event.number,
                "payload_bytes": len(event.payload),
                "one_way_delay_ns": event.one_way_delay_ns,
                "age_ns": event.age_ns,
            }
        case LinkState():
            return {
                "event": "link_state",
                "t_ns": t_ns,
                "rate_bps": event.rate_bps,
                "band": event.band,
                "rtt_ns": event.rtt_ns,
                "in_flight_bytes": event.in_flight_bytes,
                "loss_ratio": round(event.loss_ratio, 4),
                "holding": event.holding,
                "queue_ns": event.queue_ns,
                "confidence": event.confidence,
                "receiving": None if event.receiving is None else receiving_record(event.receiving),
            }
        case Receipt(key, tag, stage):
            return {"event": "receipt", "t_ns": t_ns, "topic": key, "tag": tag, "stage": stage.value}
        case Wanted(key, budget_bytes):
            return {"event": "wanted", "t_ns": t_ns, "topic": key, "budget_bytes": budget_bytes}
        case EncodingTrouble(key, what, reason, count):
            return {
                "event": "encoding",
                "t_ns": t_ns,
                "topic": key,
                "what": what,
                "reason": reason,
                "count": count,
            }
        case PeerStarted():
            return {"event": "peer_started", "t_ns": t_ns, "epoch": event.epoch, "again": event.again}
        case OperatorLost(silent_ns):
            return {"event": "operator_lost", "t_ns": t_ns, "silent_ns": silent_ns}
        case OperatorBack(silent_ns):
            return {"event": "operator_back", "t_ns": t_ns, "silent_ns": silent_ns}
        case Notice(kind, text):
            return {"event": "notice", "t_ns": t_ns, "kind": kind.value, "text": text}


def receiving_record(told: PeerEstimate) -> Record:
    """What the peer takes its direction for, under the names that our own has."""
    return {
        "rate_bps": told.rate_bps,
        "band": told.band,
        "loss_ratio": told.loss_ratio,
        "holding": told.holding,
        "queue_ns": told.queue_ns,
        "confidence": told.confidence,
    }


def ledger_record(
    endpoint: Endpoint, sends: Direction, t_ns: int, carousel: Mapping[str, SentLedger] | None = None
) -> Record:
    """All counters since the start. sends: the direction of this side's own topics.

    carousel: counters of those that leave by a link without a way back.
    """
    receives = "up" if sends == "down" else "down"
    topics: dict[str, Mapping[str, object]] = {}
    for key, sent in {**endpoint.sent_ledgers(), **(carousel or {})}.items():
        topics[key] = {"direction": sends, **sent.as_dict(), "queued": sent.queued}
    for key, received in endpoint.received_ledgers.items():
        topics[key] = {"direction": receives, **received.as_dict()}
    return {"event": "ledger", "t_ns": t_ns, "topics": topics, "datagrams": endpoint.counters_dict()}


class SentBins:
    """Sums the bytes of departing datagrams over 100 ms, one record per interval that had any."""

    def __init__(self, write: Callable[[Record], None]) -> None:
        self._write = write
        self._bin = -1
        self._wire_bytes = 0
        self._datagrams = 0

    def on_sent(self, wire_bytes: int, t_ns: int) -> None:
        """A datagram has left."""
        if t_ns // BIN_NS != self._bin:
            self.flush()
            self._bin = t_ns // BIN_NS
        self._wire_bytes += wire_bytes
        self._datagrams += 1

    def flush(self) -> None:
        """Write what is summed so far."""
        if self._datagrams:
            self._write(
                {
                    "event": "sent",
                    "t_ns": self._bin * BIN_NS,
                    "interval_ns": BIN_NS,
                    "wire_bytes": self._wire_bytes,
                    "datagrams": self._datagrams,
                }
            )
        self._wire_bytes = self._datagrams = 0

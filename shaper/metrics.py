"""Prometheus metrics of a running shaper: the ledgers of both ends, and the link."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TypeVar
from wsgiref.simple_server import WSGIServer

from prometheus_client import CollectorRegistry, start_http_server
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from shaper.endpoint import Endpoint
from shaper.events import LinkState, PeerEstimate
from shaper.ledger import ReceivedLedger, SentLedger


class MetricsError(Exception):
    """The metrics' port could not be opened."""


class MetricsServer:
    """Serves `GET /metrics`; the figures are taken when somebody asks."""

    def __init__(
        self,
        address: tuple[str, int],
        endpoint: Endpoint,
        datagrams: Callable[[], Mapping[str, int]] | None = None,
    ) -> None:
        """datagrams: counters of datagrams and drops, where there is a channel too; else the endpoint's."""
        registry = CollectorRegistry()
        registry.register(_ShaperCollector(endpoint, datagrams or endpoint.counters_dict))
        host, port = address
        try:
            served: tuple[WSGIServer, threading.Thread] = start_http_server(port, host, registry)
        except OSError as error:
            raise MetricsError(f"metrics.listen = {host}:{port}: {error.strerror}") from error
        self._server, self._thread = served

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(timeout=2)


_Ledger = TypeVar("_Ledger")


class _ShaperCollector(Collector):
    """Reads counters of another thread's endpoint: each is one integer, so none is ever half written."""

    def __init__(self, endpoint: Endpoint, datagrams: Callable[[], Mapping[str, int]]) -> None:
        self._endpoint = endpoint
        self._datagrams = datagrams

    def collect(self) -> Iterator[Metric]:
        endpoint = self._endpoint
        yield from _by_topic(
            "straitlink_sent", "Messages that this side sends.", endpoint.sent_ledgers, _sent_counters
        )
        yield from _by_topic(
            "straitlink_received",
            "Messages that this side receives.",
            lambda: endpoint.received_ledgers,
            _received_counters,
        )
        yield from _by_topic(
            "straitlink_peer_received",
            "What the other side has received of ours, as it told.",
            lambda: endpoint.peer_ledgers.received,
            _received_counters,
        )
        datagrams = CounterMetricFamily(
            "straitlink_datagrams", "Datagrams, and drops that belong to no topic.", labels=["what"]
        )
        for name, value in self._datagrams().items():
            datagrams.add_metric([name], value)
        yield datagrams
        state = endpoint.link_state()
        yield from _gauges(
            "straitlink_link",
            "Of this side's sending direction.",
            rtt_seconds=(state.rtt_ns or 0) / 1e9,
            in_flight_bytes=state.in_flight_bytes,
            **_of_estimate(state),
        )
        if state.receiving is not None:
            text = "Of the direction that this side receives by, as the other side told."
            yield from _gauges("straitlink_link_receiving", text, **_of_estimate(state.receiving))


def _of_estimate(state: LinkState | PeerEstimate) -> dict[str, float]:
    return {
        "rate_bps": state.rate_bps,
        "loss_ratio": state.loss_ratio,
        "holding": float(state.holding),
        "queue_seconds": state.queue_ns / 1e9,
        "confidence": state.confidence,
    }


def _gauges(prefix: str, text: str, **values: float) -> Iterator[Metric]:
    for name, value in values.items():
        yield GaugeMetricFamily(f"{prefix}_{name}", text, value=value)


def _by_topic(
    name: str,
    text: str,
    ledgers: Callable[[], Mapping[str, _Ledger]],
    counters: Callable[[_Ledger], Iterable[tuple[str, int]]],
) -> Iterator[Metric]:
    family = CounterMetricFamily(name, text, labels=["topic", "what"])
    for key, ledger in list(ledgers().items()):
        for what, value in counters(ledger):
            family.add_metric([key, what], value)
    yield family


def _sent_counters(ledger: SentLedger) -> Iterable[tuple[str, int]]:
    return ledger.as_dict().items()


def _received_counters(ledger: ReceivedLedger) -> Iterable[tuple[str, int]]:
    names = ("delivered", "lost", "stale", "expired", "received_bytes", "unreadable")
    return zip(names, ledger.counters(), strict=True)

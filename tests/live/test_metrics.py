"""Prometheus asks over HTTP on loopback."""

from __future__ import annotations

import re
import socket
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from shaper.metrics import MetricsError, MetricsServer
from tests.shaper.pair import MS, Pair

pytestmark = pytest.mark.live


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return int(s.getsockname()[1])


@contextmanager
def serving(pair: Pair) -> Iterator[int]:
    port = free_port()
    server = MetricsServer(("127.0.0.1", port), pair.robot.endpoint)
    try:
        yield port
    finally:
        server.close()


def scrape(port: int) -> dict[str, float]:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=5) as response:
        text = response.read().decode()
    return {
        match[1]: float(match[2]) for match in re.finditer(r"^(straitlink_\S+) (\S+)$", text, re.MULTILINE)
    }


def test_the_counters_of_both_ends_and_the_link_are_served_as_they_are_now() -> None:
    pair = Pair()
    for _ in range(3):
        pair.offer(pair.robot, "robot/state/pose", b"12345")
        pair.offer(pair.operator, "operator/command/a", b"x")
        pair.advance(2_000 * MS)
    with serving(pair) as port:
        values = scrape(port)
        pair.offer(pair.robot, "robot/state/pose", b"12345")
        later = scrape(port)
    pose = 'topic="robot/state/pose"'
    assert values[f'straitlink_sent_total{{{pose},what="offered"}}'] == 3
    assert values[f'straitlink_sent_total{{{pose},what="sent_bytes"}}'] == 15
    assert values['straitlink_received_total{topic="operator/command/a",what="delivered"}'] == 3
    assert values[f'straitlink_peer_received_total{{{pose},what="delivered"}}'] == 3
    assert values["straitlink_link_rate_bps"] == 950_000
    assert values["straitlink_link_rtt_seconds"] == pytest.approx(0.1, abs=0.01)
    assert values['straitlink_datagrams_total{what="malformed"}'] == 0
    assert later[f'straitlink_sent_total{{{pose},what="offered"}}'] == 4


def test_a_port_that_is_taken_is_told_by_field_and_address() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        address = taken.getsockname()
        with pytest.raises(MetricsError, match=rf"metrics\.listen = 127\.0\.0\.1:{address[1]}"):
            MetricsServer(address, Pair().robot.endpoint)


def test_after_closing_nobody_answers() -> None:
    with serving(Pair()) as port:
        assert scrape(port)
    with pytest.raises(OSError):
        scrape(port)

"""Sizes rise to what the path takes, fall where large datagrams vanish, and rise again when it allows it."""

from __future__ import annotations

import random

import pytest

from shaper.endpoint_settings import EndpointSettings
from shaper.notices import NoticeKind
from shaper.path_mtu import FLOOR_BYTES, START_BYTES, PathMtu
from tests.shaper.pair import MS, RULES, S
from tests.shaper.secured import SecuredPair


def send_pictures(pair: SecuredPair, count: int) -> None:
    for i in range(count):
        pair.offer(pair.robot, "robot/plan/a", bytes([i % 256]) * 5000)
        pair.offer(pair.robot, "robot/state/a", b"x")
        pair.advance(500 * MS)


def wide_pair() -> SecuredPair:
    """Both sides may send what an Ethernet frame holds."""
    settings = EndpointSettings(RULES, max_datagram_bytes=1472)
    return SecuredPair(tables={"robot": settings, "operator": settings})


@pytest.mark.parametrize(
    ("mtu_bytes", "least_bytes"), [(1500, 1472), (1392, 1368), (1230, 1206), (1200, 1200)]
)
def test_datagrams_grow_to_what_the_path_takes(mtu_bytes: int, least_bytes: int) -> None:
    pair = wide_pair()
    pair.loses = lambda data, to: len(data) > mtu_bytes
    pair.advance(400 * MS)
    send_pictures(pair, 1)
    assert max(len(data) for _, data, _ in pair.robot.sent) <= START_BYTES, "nothing larger untried"
    pair.advance(60 * S)
    send_pictures(pair, 10)
    mtu = pair.robot.link.endpoint.path_mtu
    assert least_bytes <= mtu.size_bytes <= mtu_bytes
    assert mtu.size_bytes - 8 <= max(len(data) for _, data, _ in pair.robot.sent[-60:]) <= mtu.size_bytes
    assert sum(len(p) == 5000 for p in pair.operator.payloads) == 11
    assert pair.robot.notices(NoticeKind.PATH_MTU) == [], "a path of its usual size is no news"


def test_a_black_hole_is_noticed_after_the_path_had_taken_more() -> None:
    pair = wide_pair()
    pair.advance(5 * S)
    assert pair.robot.link.endpoint.path_mtu.size_bytes == 1472
    pair.loses = lambda data, to: len(data) > 1300
    send_pictures(pair, 20)
    pair.advance(40 * S)
    assert 1276 <= pair.robot.link.endpoint.path_mtu.size_bytes <= 1300
    assert sum(len(p) == 5000 for p in pair.operator.payloads) == 20
    pair.loses = lambda data, to: False
    pair.advance(200 * S)
    assert pair.robot.link.endpoint.path_mtu.size_bytes == 1472
    fell, rose = pair.robot.notices(NoticeKind.PATH_MTU)
    assert "link.max_datagram_bytes" in fell and rose == "datagrams of 1472 bytes pass again"


def test_no_probe_of_a_size_leaves_while_the_link_is_held() -> None:
    pair = wide_pair()
    pair.advance(500 * MS)  # the first probe leaves a second after the peer is known
    pair.loses = lambda data, to: True
    send_pictures(pair, 20)
    mtu = pair.robot.link.endpoint.path_mtu
    assert pair.robot.link.endpoint.holding and mtu.size_bytes == START_BYTES
    since = len(pair.robot.sent)
    pair.advance(30 * S)
    assert max((len(data) for _, data, _ in pair.robot.sent[since:]), default=0) <= START_BYTES
    pair.loses = lambda data, to: False
    pair.advance(10 * S)
    assert mtu.size_bytes == 1472


@pytest.mark.parametrize("mtu_bytes", [1100, 900, 600])
def test_a_black_hole_is_noticed_and_the_largest_size_that_passes_is_found(mtu_bytes: int) -> None:
    pair = SecuredPair()
    pair.advance(2 * S)
    send_pictures(pair, 4)
    assert len(pair.operator.payloads) == 8
    pair.loses = lambda data, to: len(data) > mtu_bytes
    send_pictures(pair, 20)
    pair.advance(40 * S)
    mtu = pair.robot.link.endpoint.path_mtu
    assert max(FLOOR_BYTES, mtu_bytes - 24) <= mtu.size_bytes <= mtu_bytes
    assert sum(len(p) == 5000 for p in pair.operator.payloads) == 24
    (text, *_) = pair.robot.notices(NoticeKind.PATH_MTU)
    assert "link.max_datagram_bytes" in text


def test_the_configured_size_comes_back_when_the_path_is_mended() -> None:
    pair = SecuredPair()
    pair.advance(2 * S)
    pair.loses = lambda data, to: len(data) > 700
    send_pictures(pair, 20)
    pair.advance(60 * S)
    assert pair.robot.link.endpoint.path_mtu.size_bytes <= 700
    pair.loses = lambda data, to: False
    pair.advance(200 * S)
    assert pair.robot.link.endpoint.path_mtu.size_bytes == 1200


@pytest.mark.parametrize("loss", [0.02, 0.1, 0.3])
def test_random_loss_is_not_taken_for_a_black_hole_for_long(loss: float) -> None:
    pair = SecuredPair()
    pair.advance(2 * S)
    rng = random.Random(4)
    pair.loses = lambda data, to: rng.random() < loss
    small = 0
    for _ in range(100):
        send_pictures(pair, 1)
        small += pair.robot.link.endpoint.path_mtu.size_bytes < 1200
    assert small <= 15


def test_probing_costs_little_and_ends() -> None:
    mtu = PathMtu(1200)
    for _ in range(6):
        mtu.on_lost(1200)
    for _ in range(2):
        mtu.on_arrived(100)
    assert mtu.size_bytes == FLOOR_BYTES
    now_ns, sent = 0, []
    while now_ns < 3600 * S:
        size = mtu.next_probe(1200, now_ns)
        if size is not None:
            sent.append(size)
        now_ns = max(now_ns + 1, mtu.wakeup_at_ns(1200) or now_ns + S)
    assert len(sent) < 150  # nothing larger than the floor ever passes: a probe every 24 s or so
    assert mtu.size_bytes == FLOOR_BYTES


def test_a_thin_path_that_loses_everything_is_no_black_hole() -> None:
    mtu = PathMtu(1200)
    for _ in range(50):
        mtu.on_lost(1200)
    assert mtu.size_bytes == 1200


def test_no_probe_is_larger_than_full_datagrams_are_at_the_rate_of_now() -> None:
    """1,200 bytes would hold a heartbeat up for 98 ms at 100 kbit/s."""
    mtu = PathMtu(1200)
    for _ in range(6):
        mtu.on_lost(1200)
    for _ in range(2):
        mtu.on_arrived(100)
    assert mtu.next_probe(588, 0) is None and mtu.next_probe(588, 2 * S) == 588
    mtu.on_probe_arrived(588, 3 * S)
    assert mtu.size_bytes == 588
    assert mtu.next_probe(588, 4 * S) is None and mtu.wakeup_at_ns(588) is None
    larger = mtu.next_probe(1200, 4 * S)
    assert larger is not None and larger > 700
    assert mtu.next_probe(700, 8 * S) == 700, "nor is the second try of one that was lost"

"""The robot's side says when the operator is lost, goes on saying it, and takes it back."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest

from shaper.config import load_config
from shaper.errors import ConfigError
from shaper.operator_lost import OperatorBack, OperatorLost, OperatorLostSettings, OperatorWatch
from tests.shaper.pair import S
from tests.shaper.secured import SecuredPair
from tests.shaper.test_config import MINIMAL, write

SETTINGS = OperatorLostSettings("robot/operator_lost", b"stand still", after_ns=3 * S)


def said(pair: SecuredPair) -> list[str]:
    kinds = (OperatorLost, OperatorBack)
    return [type(e).__name__ for e in pair.robot.events if isinstance(e, kinds)]


def test_a_link_without_traffic_is_not_lost() -> None:
    pair = SecuredPair(operator_lost=SETTINGS)
    pair.advance(60 * S)
    assert said(pair) == []


def test_the_operator_is_lost_after_its_time_and_back_at_the_first_datagram() -> None:
    pair = SecuredPair(operator_lost=SETTINGS)
    pair.advance(10 * S)
    pair.loses = lambda data, to: True
    heard_ns = pair.robot.channel.last_heard_ns
    assert heard_ns is not None
    pair.advance(heard_ns - pair.robot.offset_ns + 3 * S - pair.now_ns - 1)
    assert said(pair) == []
    pair.advance(1)
    assert said(pair) == ["OperatorLost"]
    pair.advance(2 * S)
    assert said(pair) == ["OperatorLost"] * 3  # for whoever starts to listen meanwhile
    pair.loses = lambda data, to: False
    pair.advance(4 * S)
    assert said(pair)[-1] == "OperatorBack" and said(pair).count("OperatorBack") == 1
    assert pair.robot.link.watch is not None and not pair.robot.link.watch.lost


def test_an_operator_that_never_comes_is_lost() -> None:
    pair = SecuredPair(operator_lost=SETTINGS)
    pair.loses = lambda data, to: True
    pair.advance(4 * S)
    (first, *_) = [e for e in pair.robot.events if isinstance(e, OperatorLost)]
    assert first == OperatorLost(3 * S, True)


def test_a_stranger_is_no_operator() -> None:
    """Datagrams that nobody has sealed, and an old one again, do not keep the robot going."""
    pair = SecuredPair(operator_lost=SETTINGS)
    pair.advance(5 * S)
    old = [data for _, data, _ in pair.operator.sent]
    pair.loses = lambda data, to: True
    for _ in range(40):
        pair.advance(S // 10)
        for data in (old[-1], bytes(40), b"\x02" + bytes(60)):
            pair.receive(pair.robot, data, pair.operator.address)
    assert "OperatorLost" in said(pair)


def test_each_side_speaks_at_least_once_a_second() -> None:
    pair = SecuredPair()
    pair.advance(30 * S)
    for host in pair.hosts:
        times = [t for t, _, _ in host.sent if t > 2 * S]
        assert max(b - a for a, b in pairwise(times)) <= S


def test_silence_is_counted_from_the_last_word() -> None:
    watch = OperatorWatch(SETTINGS, 0)
    assert watch.look(None, 2 * S) is None
    assert watch.look(2 * S, 4 * S) is None
    assert watch.wakeup_at_ns() == 5 * S
    assert watch.look(2 * S, 5 * S) == OperatorLost(3 * S, True)
    assert watch.look(2 * S, 6 * S) == OperatorLost(4 * S, False)
    assert watch.look(7 * S, 7 * S) == OperatorBack(5 * S)


def test_the_configuration_says_what_to_publish(tmp_path: Path) -> None:
    table = '\n[operator_lost]\nkey = "robot/stop"\npayload = "{}"\nafter_s = 2\nback_payload = "go"\n'
    found = load_config(write(tmp_path, MINIMAL + table)).operator_lost
    assert found == OperatorLostSettings("robot/stop", b"{}", 2 * S, S, "text/plain", b"go")
    with pytest.raises(ConfigError, match="robot's side only"):
        load_config(write(tmp_path, MINIMAL.replace('side = "robot"', 'side = "operator"') + table))
    with pytest.raises(ConfigError, match="without wildcards"):
        load_config(write(tmp_path, MINIMAL + table.replace("robot/stop", "robot/**")))

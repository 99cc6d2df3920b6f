"""What the outlet does while nobody listens yet: a bus whose hub was away is joined again seconds later."""

from __future__ import annotations

import time
from collections.abc import Iterator

import pytest

from shaper.bus import BusOutlet, BusSettings, Session, open_bus
from straitlink.demo.configs import free_addresses
from tests.live.processes import wait_until

pytestmark = pytest.mark.live


@pytest.fixture
def hub() -> Iterator[tuple[Session, str]]:
    endpoint = free_addresses().robot_bus
    session = open_bus(BusSettings(listen=[endpoint]))
    yield session, endpoint
    session.close()


def test_what_may_wait_reaches_a_subscriber_that_comes_later_in_order(hub: tuple[Session, str]) -> None:
    session, endpoint = hub
    outlet = BusOutlet(session)
    until_s = time.monotonic() + 20
    for number in range(3):
        outlet.publish("robot/done", bytes([number]), "", b"", patient_until_s=until_s)
    outlet.publish("robot/done", bytes([3]), "", b"")  # may not wait, but must not overtake either
    late = open_bus(BusSettings(connect=[endpoint]))
    got: list[int] = []
    kept = late.declare_subscriber("robot/**", lambda sample: got.append(sample.payload.to_bytes()[0]))
    wait_until(lambda: len(got) == 4)
    assert got == [0, 1, 2, 3]
    kept.undeclare()
    outlet.close()
    late.close()


def test_who_waits_holds_nobody_else_up_and_not_for_longer_than_he_may(hub: tuple[Session, str]) -> None:
    session, _ = hub
    outlet = BusOutlet(session)
    put: list[str] = []
    got: list[bytes] = []
    kept = session.declare_subscriber("robot/heard", lambda sample: got.append(sample.payload.to_bytes()))
    until_s = time.monotonic() + 0.5
    outlet.publish("robot/unheard", b"a", "", b"", lambda: put.append("unheard"), until_s)
    outlet.publish("robot/heard", b"b", "", b"", lambda: put.append("heard"), until_s)
    wait_until(lambda: len(put) == 2)
    assert put == ["heard", "unheard"]
    assert time.monotonic() >= until_s
    wait_until(lambda: got == [b"b"])
    kept.undeclare()
    outlet.close()


def test_closing_publishes_what_still_waits(hub: tuple[Session, str]) -> None:
    session, _ = hub
    outlet = BusOutlet(session)
    put: list[int] = []
    outlet.publish("robot/unheard", b"a", "", b"", lambda: put.append(1), time.monotonic() + 60)
    outlet.close()
    assert put == [1]

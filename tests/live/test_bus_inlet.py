"""Samples of a bus: the shaper is told that some have come, or looks by itself while many come."""

from __future__ import annotations

import threading
import time

import pytest

from shaper.bus import BusInlet, BusSettings, open_bus
from straitlink.demo.configs import free_addresses
from tests.live.processes import wait_until

pytestmark = pytest.mark.live


def test_whoever_looks_again_is_not_told_and_misses_nothing_when_that_ends() -> None:
    endpoint = free_addresses().robot_bus
    shaper = open_bus(BusSettings(listen=[endpoint]))
    robot = open_bus(BusSettings(connect=[endpoint]))
    told: list[int] = []
    inlet = BusInlet(shaper, ["robot/**"], lambda key: False, lambda: told.append(1), time.monotonic_ns)
    try:
        publisher = robot.declare_publisher("robot/plan")
        wait_until(lambda: bool(publisher.matching_status.matching))
        taken: list[bytes] = []
        publisher.put(b"0")
        wait_until(lambda: len(told) == 1)
        taken += [sample.payload.to_bytes() for sample in inlet.take(look_again=True)]
        for number in range(1, 200):
            publisher.put(str(number).encode())
        looked: list[bytes] = []

        def look() -> bool:
            looked.extend(sample.payload.to_bytes() for sample in inlet.take(look_again=True))
            return len(looked) == 199

        wait_until(look)
        assert len(told) == 1, "of none of these"
        taken += looked
        assert inlet.take() == []
        publisher.put(b"200")
        wait_until(lambda: len(told) == 2)
        taken += [sample.payload.to_bytes() for sample in inlet.take()]
        assert taken == [str(number).encode() for number in range(201)]
    finally:
        inlet.close()
        robot.close()
        shaper.close()


def test_samples_and_answers_start_no_threads_of_python() -> None:
    endpoint = free_addresses().robot_bus
    shaper = open_bus(BusSettings(listen=[endpoint]))
    robot = open_bus(BusSettings(connect=[endpoint]))
    with robot.declare_queryable("robot/view", lambda query: query.reply("robot/view", b"view")):
        before = threading.enumerate()
        inlet = BusInlet(shaper, ["robot/**"], lambda key: True, lambda: None, time.monotonic_ns)
        try:
            publisher = robot.declare_publisher("robot/state")
            wait_until(lambda: bool(publisher.matching_status.matching))
            publisher.put(b"state")
            taken: dict[str, bytes] = {}

            def look() -> bool:
                inlet.ask("robot/view", 1000)
                taken.update({sample.key: sample.payload.to_bytes() for sample in inlet.take()})
                assert set(threading.enumerate()) <= set(before)
                return len(taken) == 2

            wait_until(look)
            assert taken == {"robot/state": b"state", "robot/view": b"view"}
        finally:
            inlet.close()
            robot.close()
            shaper.close()

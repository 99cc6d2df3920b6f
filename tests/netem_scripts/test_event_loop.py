from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem_scripts.event_loop import EventLoop, EventLoopError


@given(st.lists(st.integers(0, 20)))
def test_callbacks_run_by_time_then_in_the_order_asked_for(times_ns: list[int]) -> None:
    loop, ran = EventLoop(), []
    for number, when_ns in enumerate(times_ns):
        loop.call_at(when_ns, lambda number=number: ran.append((loop.now_ns, number)))  # type: ignore[misc]
    loop.run_until(20)
    assert ran == sorted((when_ns, number) for number, when_ns in enumerate(times_ns))


def test_a_callback_at_the_end_runs_and_one_after_it_waits() -> None:
    loop, ran = EventLoop(), []
    loop.call_at(10, lambda: ran.append("at"))
    loop.call_at(11, lambda: ran.append("after"))
    loop.run_until(10)
    assert ran == ["at"] and loop.now_ns == 10 and loop.next_at_ns() == 11
    loop.run_until(100)
    assert ran == ["at", "after"] and loop.now_ns == 100 and loop.next_at_ns() is None


def test_a_callback_asked_for_now_runs_after_what_is_already_due_now() -> None:
    loop, ran = EventLoop(), []

    def first() -> None:
        ran.append("first")
        loop.call_at(loop.now_ns, lambda: ran.append("asked for meanwhile"))

    loop.call_at(5, first)
    loop.call_at(5, lambda: ran.append("second"))
    loop.run_until(5)
    assert ran == ["first", "second", "asked for meanwhile"]


def test_a_callback_in_the_past_is_refused() -> None:
    loop = EventLoop(start_ns=7)
    with pytest.raises(EventLoopError, match="when_ns = 6 must not be before now, 7"):
        loop.call_at(6, lambda: None)


def test_running_until_an_instant_that_has_passed_does_not_turn_time_back() -> None:
    loop = EventLoop(start_ns=7)
    loop.run_until(3)
    assert loop.now_ns == 7

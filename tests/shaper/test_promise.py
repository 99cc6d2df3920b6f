from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from shaper.promise import PROMISES_NS, promise_code
from tests.shaper.pair import MS, Pair, S


@given(st.integers(0, PROMISES_NS[-1]))
def test_a_promise_is_never_shorter_than_meant_and_hardly_longer(within_ns: int) -> None:
    promised_ns = PROMISES_NS[promise_code(within_ns)]
    assert within_ns <= promised_ns <= max(1 * MS, within_ns * 1.045)


def test_whoever_promises_a_datagram_sends_one_in_time() -> None:
    pair = Pair()
    for _ in range(40):
        pair.offer(pair.robot, "robot/state/a", bytes(5000))
        pair.advance(170 * MS)
    pair.advance(5 * S)
    for side in (pair.robot, pair.operator):
        times_ns = [at_ns for at_ns, _ in side.sent]
        promises_ns = [PROMISES_NS[header.promise] for header, _ in side.decoded]
        for at_ns, promise_ns, next_ns in zip(times_ns, promises_ns, times_ns[1:], strict=False):
            assert next_ns - at_ns <= promise_ns


def test_a_regular_stream_promises_little_more_than_its_period() -> None:
    pair = Pair()
    for _ in range(40):
        pair.offer(pair.robot, "robot/state/a", bytes(50))
        pair.advance(100 * MS)
    assert max(PROMISES_NS[header.promise] for header, _ in pair.robot.decoded[-10:]) < 300 * MS


def test_after_a_stream_has_ended_promises_grow_to_a_beat() -> None:
    pair = Pair()
    for _ in range(40):
        pair.offer(pair.robot, "robot/state/a", bytes(50))
        pair.advance(100 * MS)
    ended = len(pair.robot.decoded)
    pair.advance(10 * S)
    after = pair.robot.decoded[ended:]
    assert PROMISES_NS[after[-1][0].promise] > 900 * MS
    assert len(after) < 25

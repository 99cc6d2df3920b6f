"""The account balances, at each end and between them."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shaper.frames import HelloFrame, LedgerFrame, MessageFrame
from shaper.ledger import AGE_BOUNDS_MS, ReceivedLedger
from shaper.queues import TopicQueue
from shaper.reliable import ReliableQueue
from shaper.shared_state import ChangesQueue
from shaper.traffic_class import DEFAULT_CLASSES, TopicRule
from tests.shaper.pair import FAST, MS, RULES, THIN, Pair, S
from tests.shaper.unreliable import FATES, suffer

KEYS = ["heartbeat", "command/a", "plan/a", "state/a", "state/slow", "status/a", "perception/a", "bulk/a"]
SLOW = TopicRule("robot/state/slow", DEFAULT_CLASSES["state"], min_period_ns=300 * MS)


def waits(queue: TopicQueue) -> int:
    """Messages that are neither gone nor settled, by looking at the queue itself."""
    if isinstance(queue, ChangesQueue):
        return queue._pending + queue._carried
    if isinstance(queue, ReliableQueue):
        return len(queue.waiting) + len(queue.outstanding) + len(queue._abandoned)
    return len(queue.waiting) + (queue.departing is not None)


@settings(max_examples=60)
@given(
    FATES,
    st.lists(
        st.tuples(
            st.sampled_from([*KEYS, "robot restarts", "operator restarts"]),
            st.integers(0, 9000),
            st.integers(0, 200 * MS),
        ),
        max_size=50,
    ),
    st.sampled_from([FAST, THIN]),
)
def test_after_every_step_what_was_offered_is_what_became_of_it_and_what_waits(
    fates: list[str], acts: list[tuple[str, int, int]], band: object
) -> None:
    pair = Pair(rules=(SLOW, *RULES), bands=(band,))  # type: ignore[arg-type]
    suffer(pair, fates)
    for name, size, gap_ns in acts:
        if name.endswith("restarts"):
            pair.restart(pair.robot if name.startswith("robot") else pair.operator)
        else:
            pair.offer(pair.robot, f"robot/{name}", bytes(size))
        until_ns = pair.now_ns + gap_ns
        while pair.next_ns() <= until_ns:
            pair.step()
            for queue in pair.robot.endpoint._outgoing.queues():
                assert queue.ledger.queued == waits(queue), queue.key
                assert min(queue.ledger.counters()) >= 0
        pair.now_ns = until_ns
    pair.advance(130 * S)  # past every time to live
    assert all(ledger.queued == 0 for ledger in pair.robot.endpoint.sent_ledgers().values())


def test_between_the_ends_what_was_sent_is_delivered_stale_too_late_or_lost() -> None:
    pair, sent = Pair(), 0

    def every_seventh_is_lost(datagram: bytes) -> bool:
        nonlocal sent
        sent += 1
        return sent % 7 == 0

    pair.robot.loses = every_seventh_is_lost
    for i in range(300):
        pair.offer(pair.robot, "robot/state/a", b"%d" % i)
        pair.offer(pair.robot, "robot/bulk/b", bytes(50))
        pair.advance(30 * MS)
    pair.robot.loses = lambda datagram: False
    for key in ("robot/state/a", "robot/bulk/b"):
        pair.offer(pair.robot, key, b"last")  # so that a lost one before it shows
    pair.advance(1 * S)
    for key in ("robot/state/a", "robot/bulk/b"):
        here = pair.robot.endpoint.sent_ledgers()[key]
        there = pair.operator.endpoint.received_ledgers[key]
        assert here.sent == there.delivered + there.lost + there.stale + there.expired
        assert there.lost > 20


# What the ends tell each other.


def test_both_ends_come_to_know_both_halves() -> None:
    pair = Pair()
    for i in range(40):
        for name in ("heartbeat", "state/a", "command/a", "bulk/a", "bulk/b", "bulk/c"):
            pair.offer(pair.robot, f"robot/{name}", bytes(40))
        pair.offer(pair.operator, "operator/command/a", b"%d" % i)
        pair.advance(50 * MS)
    pair.advance(6 * S)
    for ours, theirs in ((pair.robot, pair.operator), (pair.operator, pair.robot)):
        told = theirs.endpoint.peer_ledgers.sent
        assert {k: v.counters() for k, v in told.items()} == {
            k: v.counters() for k, v in ours.endpoint.sent_ledgers().items()
        }
        heard = ours.endpoint.peer_ledgers.received
        assert {k: v.counters() for k, v in heard.items()} == {
            k: v.counters() for k, v in theirs.endpoint.received_ledgers.items()
        }


def test_the_exchange_costs_a_few_bytes_a_second_and_nothing_when_nothing_changes() -> None:
    pair = Pair()
    for _ in range(100):
        for i in range(30):
            pair.offer(pair.robot, f"robot/state/{i}", bytes(10))
        pair.advance(100 * MS)
    rows = [f for f in pair.robot.frames(LedgerFrame) if isinstance(f, LedgerFrame)]
    assert 0 < sum(len(f.rows) for f in rows) <= 4 * 11
    pair.advance(20 * S)
    pair.forget_history()
    pair.advance(20 * S)
    assert pair.robot.frames(LedgerFrame) == pair.operator.frames(LedgerFrame) == []
    assert len(pair.robot.frames(HelloFrame)) >= 19


def test_a_lost_row_is_made_good_by_the_next_of_its_topic() -> None:
    pair = Pair()
    pair.offer(pair.robot, "robot/state/a", b"x")
    pair.advance(100 * MS)
    pair.robot.loses = lambda datagram: True
    pair.advance(2 * S)
    pair.robot.loses = lambda datagram: False
    pair.offer(pair.robot, "robot/state/a", b"x")
    pair.advance(2500 * MS)
    assert pair.operator.endpoint.peer_ledgers.sent["robot/state/a"].offered == 2


def test_what_a_former_peer_told_is_forgotten() -> None:
    pair = Pair()
    pair.offer(pair.robot, "robot/state/a", b"x")
    pair.advance(3 * S)
    assert pair.operator.endpoint.peer_ledgers.sent
    pair.restart(pair.robot)
    pair.advance(3 * S)
    assert pair.operator.endpoint.peer_ledgers.sent == {}


# Ages.


@pytest.mark.parametrize(
    ("age_ms", "bucket"), [(0, 0), (20, 0), (21, 1), (50, 1), (650, 5), (30_000, 9), (30_001, 10)]
)
def test_an_age_falls_into_the_first_bucket_whose_bound_it_does_not_exceed(age_ms: int, bucket: int) -> None:
    ledger = ReceivedLedger()
    ledger.on_delivered(10, age_ms * MS)
    assert ledger.ages.index(1) == bucket
    assert len(ledger.ages) == len(AGE_BOUNDS_MS) + 1


def test_the_ages_of_what_was_delivered_are_counted() -> None:
    pair = Pair()
    for age_ms in (10, 10, 100, 1500):
        pair.offer(pair.robot, "robot/state/a", b"x", age_ns=age_ms * MS)
        pair.advance(200 * MS)
    ages = pair.operator.endpoint.received_ledgers["robot/state/a"].ages
    assert (sum(ages), ages[2], ages[3], ages[6]) == (4, 2, 1, 1)  # 50 ms of link each


# The age gate.


@pytest.mark.parametrize("name", ["state/a", "bulk/a"])
def test_what_arrives_after_its_time_to_live_is_not_delivered_and_both_sides_know(name: str) -> None:
    pair, key = Pair(), f"robot/{name}"
    pair.offer(pair.robot, key, b"first")
    pair.advance(500 * MS)
    pair.offer(pair.robot, key, b"late")
    pair.robot.underway = [(at_ns + 61 * S, datagram) for at_ns, datagram in pair.robot.underway]
    pair.advance(65 * S)
    assert pair.operator.payloads == [b"first"]
    assert pair.operator.endpoint.received_ledgers[key].expired == 1
    assert pair.robot.endpoint.peer_ledgers.received[key].expired == 1


def test_what_arrives_just_in_time_is_delivered() -> None:
    pair = Pair()
    pair.offer(pair.robot, "robot/state/a", b"x", age_ns=1940 * MS)
    pair.advance(1 * S)
    assert pair.operator.payloads == [b"x"]


def test_a_state_is_true_until_it_changes_however_old() -> None:
    pair = Pair()
    pair.offer(pair.robot, "robot/status/mode", b"walk", age_ns=7200 * S)
    pair.advance(1 * S)
    assert pair.operator.payloads == [b"walk"]
    assert [f.name.ttl_ms for f in pair.robot.frames(MessageFrame) if isinstance(f, MessageFrame) and f.name]

"""What must arrive: once, in order, or reported expired on both sides."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shaper.frames import MessageFrame, Outcome, SkipFrame
from shaper.link_estimator import PresetBand
from shaper.reliable import MAX_OUTSTANDING, ReliableQueue
from shaper.traffic_class import DEFAULT_CLASSES, TopicRule
from tests.shaper.pair import FAST, MS, THIN, Pair, S, Side
from tests.shaper.unreliable import FATES, suffer

PLAN = "robot/plan/walk"
COMMAND = "robot/command/step"
SHORT = TopicRule("robot/command/**", replace(DEFAULT_CLASSES["command"], ttl_ns=1 * S))


def queue_of(pair: Pair, key: str = PLAN) -> ReliableQueue:
    queue = next(q for q in pair.robot.endpoint._outgoing.queues() if q.key == key)
    assert isinstance(queue, ReliableQueue)
    return queue


def parts(side: Side) -> list[MessageFrame]:
    return [f for f in side.frames(MessageFrame) if isinstance(f, MessageFrame)]


def settled(pair: Pair, key: str = PLAN) -> bool:
    return pair.robot.endpoint.sent_ledgers()[key].queued == 0


# Once and in order.


@settings(max_examples=60)
@given(FATES, st.lists(st.tuples(st.sampled_from([0, 10, 900, 4000]), st.integers(0, 80 * MS)), max_size=25))
def test_whatever_the_link_does_all_arrive_once_and_in_order(
    fates: list[str], messages: list[tuple[int, int]]
) -> None:
    pair = Pair()
    suffer(pair, fates)
    offered = []
    for tag, (size, gap_ns) in enumerate(messages):
        offered.append(b"%d " % tag + bytes(size))
        pair.offer(pair.robot, PLAN, offered[-1], tag=tag)
        pair.advance(gap_ns)
    pair.advance(20 * S)
    assert pair.operator.payloads == offered
    for tag in range(len(offered)):
        assert pair.robot.stages(tag) == ["queued", "sent", "delivered"]
    assert not offered or settled(pair)


@settings(max_examples=60)
@given(FATES, st.integers(1, 30), st.integers(0, 300 * MS), st.integers(100 * MS, 3 * S))
def test_each_is_delivered_or_expired_and_never_both(
    fates: list[str], count: int, gap_ns: int, ttl_ns: int
) -> None:
    rule = TopicRule("robot/command/**", replace(DEFAULT_CLASSES["command"], ttl_ns=ttl_ns))
    pair = Pair(rules=(rule,))
    suffer(pair, fates)
    for tag in range(count):
        pair.offer(pair.robot, COMMAND, b"%d" % tag, tag=tag)
        pair.advance(gap_ns)
    pair.advance(20 * S)
    arrived = [int(payload) for payload in pair.operator.payloads]
    assert arrived == sorted(set(arrived))
    for tag in range(count):
        assert pair.robot.stages(tag)[-1] == ("delivered" if tag in arrived else "expired")
        assert len(pair.robot.stages(tag)) == len(set(pair.robot.stages(tag)))
    ledger = pair.robot.endpoint.sent_ledgers()[COMMAND]
    assert (ledger.sent, ledger.expired, ledger.queued) == (len(arrived), count - len(arrived), 0)


@pytest.mark.parametrize("message_bytes", [20, 3000])
def test_what_is_repeated_is_little_more_than_what_was_lost(message_bytes: int) -> None:
    pair, sent = Pair(), 0

    def every_eighth_is_lost(datagram: bytes) -> bool:
        nonlocal sent
        sent += 1
        return sent % 8 == 0

    pair.robot.loses = every_eighth_is_lost
    for tag in range(200):
        pair.offer(pair.robot, PLAN, bytes(message_bytes), tag=tag)
        pair.advance(40 * MS)
    pair.advance(5 * S)
    assert len(pair.operator.payloads) == 200
    ledger = pair.robot.endpoint.sent_ledgers()[PLAN]
    first = [f for f in parts(pair.robot)]
    lost_bytes = sum(
        sum(len(f.data) for f in frames if isinstance(f, MessageFrame))
        for n, (_, frames) in enumerate(pair.robot.decoded, start=1)
        if n % 8 == 0
    )
    assert sum(len(f.data) for f in first) == ledger.sent_bytes + ledger.repeated_bytes
    assert 0 < ledger.repeated_bytes <= 1.3 * lost_bytes


def test_nothing_is_repeated_on_a_link_that_only_repeats_and_delays_a_little() -> None:
    pair = Pair()
    suffer(pair, ["fine"] * 9 + ["twice"] + ["fine"] * 600)
    for tag in range(200):
        pair.offer(pair.robot, PLAN, b"x", tag=tag)
        pair.advance(40 * MS)
    pair.advance(1 * S)
    assert len(pair.operator.payloads) == 200
    assert pair.robot.endpoint.sent_ledgers()[PLAN].repeated_bytes == 0


def test_receipts_that_are_lost_are_told_again() -> None:
    pair = Pair()
    pair.operator.loses = lambda datagram: True
    pair.offer(pair.robot, PLAN, b"x", tag=5)
    pair.advance(60 * MS)
    assert pair.operator.payloads == [b"x"]
    pair.advance(2 * S)
    pair.operator.loses = lambda datagram: False
    pair.advance(1 * S)
    assert pair.robot.stages(5) == ["queued", "sent", "delivered"]
    assert pair.operator.payloads == [b"x"]


def test_a_lost_message_is_repeated_within_a_probe_timeout_though_nothing_follows_it() -> None:
    pair = Pair()
    pair.offer(pair.robot, PLAN, b"x", tag=5)
    assert pair.drop(pair.robot) == 1
    pair.advance(1 * S)
    assert pair.operator.payloads == [b"x"]
    assert pair.operator.delivered[0].age_ns < 700 * MS


def test_no_more_are_under_way_than_the_window_holds() -> None:
    pair = Pair(rules=(TopicRule("robot/plan/**", replace(DEFAULT_CLASSES["plan"], depth=500)),))
    pair.operator.loses = lambda datagram: True  # no receipts
    for tag in range(200):
        pair.offer(pair.robot, PLAN, b"%d" % tag, tag=tag)
    pair.advance(3 * S)
    assert len({f.number for f in parts(pair.robot)}) == MAX_OUTSTANDING
    pair.operator.loses = lambda datagram: False
    pair.advance(10 * S)
    assert pair.operator.payloads == [b"%d" % tag for tag in range(200)]


# Too late.


def test_one_that_expires_in_the_queue_is_never_sent_and_told_so() -> None:
    pair = Pair(rules=(SHORT,))
    pair.offer(pair.robot, COMMAND, b"late", age_ns=1 * S + 1, tag=3)
    pair.advance(1 * S)
    assert pair.robot.stages(3) == ["queued", "expired"]
    assert parts(pair.robot) == []


def test_one_that_gives_way_in_a_full_queue_is_told_so() -> None:
    pair = Pair(bands=(THIN,), rules=(TopicRule("**", replace(DEFAULT_CLASSES["plan"], depth=2)),))
    for tag in range(6):
        pair.offer(pair.robot, PLAN, bytes(3000), tag=tag)
    told = [pair.robot.stages(tag) for tag in range(6)]
    assert told == [["queued"], ["queued", "shed"], ["queued", "shed"], ["queued", "shed"], *[["queued"]] * 2]


def test_one_that_arrives_too_late_is_not_delivered_and_both_sides_know() -> None:
    pair = Pair(rules=(SHORT,))
    pair.offer(pair.robot, COMMAND, b"first", tag=1)
    pair.advance(1 * S)
    pair.offer(pair.robot, COMMAND, b"late", tag=2)
    pair.robot.underway = [(at_ns + 2 * S, datagram) for at_ns, datagram in pair.robot.underway]
    pair.robot.loses = lambda datagram: True
    pair.advance(3 * S)
    pair.robot.loses = lambda datagram: False
    pair.advance(3 * S)
    assert pair.operator.payloads == [b"first"]
    assert pair.robot.stages(2) == ["queued", "sent", "expired"]
    assert pair.robot.endpoint.sent_ledgers()[COMMAND].expired == 1


@pytest.mark.parametrize("known", [True, False], ids=["a known topic", "a topic never heard of"])
def test_those_that_expire_in_a_blackout_are_told_and_the_next_arrives_at_once(known: bool) -> None:
    pair = Pair(rules=(SHORT,))
    if known:
        pair.offer(pair.robot, COMMAND, b"before")
        pair.advance(1 * S)
    pair.robot.loses = pair.operator.loses = lambda datagram: True
    for tag in range(5):
        pair.offer(pair.robot, COMMAND, b"in the dark", tag=100 + tag)
    pair.advance(10 * S)
    pair.robot.loses = pair.operator.loses = lambda datagram: False
    pair.advance(2 * S)
    pair.offer(pair.robot, COMMAND, b"after", tag=200)
    pair.advance(2 * S)
    assert pair.operator.payloads[-1] == b"after"
    assert b"in the dark" not in pair.operator.payloads
    assert [pair.robot.stages(100 + tag)[-1] for tag in range(5)] == ["expired"] * 5
    assert pair.robot.stages(200)[-1] == "delivered"
    assert settled(pair, COMMAND)


def test_what_expired_in_the_dark_is_settled_even_if_nothing_follows() -> None:
    pair = Pair(rules=(SHORT,))
    pair.robot.loses = lambda datagram: True
    pair.offer(pair.robot, COMMAND, bytes(3000), tag=1)
    pair.advance(5 * S)
    pair.robot.loses = lambda datagram: False
    pair.advance(3 * S)
    assert pair.robot.stages(1) == ["queued", "sent", "expired"]
    assert settled(pair, COMMAND)
    pair.forget_history()
    pair.advance(20 * S)
    assert len(pair.robot.sent) < 50  # and nobody probes for its outcome any more


def test_one_given_up_between_two_others_holds_back_neither() -> None:
    """Publishers of one key need not agree on capture times."""
    pair = Pair(rules=(SHORT,))
    pair.offer(pair.robot, COMMAND, b"before")
    pair.advance(1 * S)
    pair.robot.loses = lambda datagram: True
    pair.offer(pair.robot, COMMAND, b"0", tag=0)
    pair.offer(pair.robot, COMMAND, b"1", age_ns=800 * MS, tag=1)
    pair.offer(pair.robot, COMMAND, b"2", tag=2)
    pair.advance(300 * MS)
    pair.robot.loses = lambda datagram: False
    pair.advance(600 * MS)
    assert [pair.robot.stages(tag)[-1] for tag in range(3)] == ["delivered", "expired", "delivered"]
    assert pair.operator.payloads == [b"before", b"0", b"2"]


# Restarts.


def test_a_receiver_that_restarts_gets_all_that_it_gave_no_receipt_for_once_and_in_order() -> None:
    pair = Pair()
    pair.operator.loses = lambda datagram: True
    for tag in range(10):
        pair.offer(pair.robot, PLAN, b"%d" % tag, tag=tag)
        pair.advance(20 * MS)
    pair.restart(pair.operator)
    pair.operator.loses = lambda datagram: False
    pair.advance(3 * S)
    assert pair.operator.payloads == [b"%d" % tag for tag in range(10)]
    assert [pair.robot.stages(tag) for tag in range(10)] == [["queued", "sent", "delivered"]] * 10


def test_a_receiver_that_restarts_waits_for_none_that_it_had_settled() -> None:
    """Of three outstanding only the middle one's receipt came through."""
    pair = Pair()
    pair.offer(pair.robot, PLAN, b"before")
    pair.advance(1 * S)
    pair.operator.loses = lambda datagram: True
    for tag in range(3):
        pair.offer(pair.robot, PLAN, b"%d" % tag, tag=tag)
    pair.advance(60 * MS)
    queue = queue_of(pair)
    queue.on_outcome(sorted(queue.outstanding)[1], Outcome.DELIVERED)
    assert len(queue.outstanding) == 2
    pair.restart(pair.operator)
    pair.operator.loses = lambda datagram: False
    pair.advance(2 * S)
    assert pair.operator.payloads == [b"0", b"2"]
    assert [pair.robot.stages(tag)[-1] for tag in range(3)] == ["delivered"] * 3


def test_a_message_that_is_leaving_as_the_receiver_restarts_arrives_whole_and_is_told_so() -> None:
    pair = Pair()
    pair.offer(pair.robot, PLAN, bytes(60_000), tag=1)
    pair.offer(pair.robot, PLAN, b"next", tag=2)
    pair.advance(250 * MS)
    pair.restart(pair.operator)
    pair.advance(3 * S)
    assert pair.operator.payloads == [bytes(60_000), b"next"]
    assert [pair.robot.stages(tag) for tag in (1, 2)] == [["queued", "sent", "delivered"]] * 2


@settings(max_examples=40)
@given(FATES, st.lists(st.sampled_from(["offer", "offer", "offer", "restart"]), min_size=5, max_size=30))
def test_after_any_restarts_of_the_receiver_every_life_has_an_order_and_nothing_is_missing(
    fates: list[str], acts: list[str]
) -> None:
    pair, lives, count = Pair(), [], 0
    suffer(pair, fates)
    for act in acts:
        if act == "offer":
            pair.offer(pair.robot, PLAN, b"%d" % count, tag=count)
            count += 1
        else:
            lives.append([int(p) for p in pair.operator.payloads])
            pair.restart(pair.operator)
        pair.advance(120 * MS)
    pair.advance(20 * S)
    lives.append([int(p) for p in pair.operator.payloads])
    for life in lives:
        assert life == sorted(set(life))
    assert set().union(*lives) == set(range(count))
    assert [pair.robot.stages(tag)[-1] for tag in range(count)] == ["delivered"] * count
    assert count == 0 or settled(pair)


def test_a_sender_that_restarts_says_so_and_its_new_messages_arrive() -> None:
    pair = Pair()
    for _ in range(3):
        pair.offer(pair.robot, PLAN, b"old")
    pair.restart(pair.robot)
    pair.advance(1 * S)
    for tag in range(3):
        pair.offer(pair.robot, PLAN, b"%d" % tag, tag=tag)
    pair.advance(1 * S)
    assert [p for p in pair.operator.payloads if p != b"old"] == [b"0", b"1", b"2"]
    assert pair.operator.payloads.count(b"old") <= 3
    assert [s.again for s in pair.operator.peer_starts] == [True]


# A long blackout.


@pytest.mark.parametrize("band", [FAST, THIN], ids=["fast", "thin"])
def test_after_a_blackout_all_come_once_and_in_order(band: PresetBand) -> None:
    pair = Pair(bands=(band,))
    pair.robot.loses = pair.operator.loses = lambda datagram: True
    for tag in range(20):
        pair.offer(pair.robot, PLAN, b"%d" % tag + bytes(500), tag=tag)
        pair.advance(1500 * MS)
    pair.robot.loses = pair.operator.loses = lambda datagram: False
    pair.forget_history()
    pair.advance(8 * S)
    assert [int(p[:2].strip(b"\0")) for p in pair.operator.payloads] == list(range(20))


def test_the_number_of_a_message_goes_round() -> None:
    pair = Pair()
    pair.robot.endpoint._outgoing._open(PLAN)
    queue_of(pair).next_number = 65_530
    for tag in range(12):
        pair.offer(pair.robot, PLAN, b"%d" % tag, tag=tag)
        if tag == 4:
            pair.drop(pair.robot)
        pair.advance(20 * MS)
    pair.advance(1 * S)
    assert pair.operator.payloads == [b"%d" % tag for tag in range(12)]
    assert [pair.robot.stages(tag)[-1] for tag in range(12)] == ["delivered"] * 12


def test_skips_are_few() -> None:
    pair = Pair(rules=(SHORT,))
    pair.offer(pair.robot, COMMAND, b"before")
    pair.advance(1 * S)
    pair.robot.loses = lambda datagram: True
    for _ in range(30):
        pair.offer(pair.robot, COMMAND, b"x")
        pair.advance(100 * MS)
    pair.robot.loses = lambda datagram: False
    pair.forget_history()
    pair.advance(5 * S)
    assert 1 <= len(pair.robot.frames(SkipFrame)) <= 10

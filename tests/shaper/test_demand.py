"""What there is room for: budgets, topics that are asked for, and shares that are guaranteed."""

from __future__ import annotations

import itertools
import random
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shaper.demand import PULL_TIMEOUT_NS, Demand
from shaper.events import Wanted
from shaper.frames import MessageFrame
from shaper.link_estimator import PresetBand
from shaper.traffic_class import DEFAULT_CLASSES, Keep, TopicRule
from tests.shaper.pair import FAST, MS, RULES, THIN, Pair, S

IMAGE = "robot/camera/image"
PULL = TopicRule(IMAGE, DEFAULT_CLASSES["perception"], min_period_ns=1 * S, pull=True)


def pull_pair(band: PresetBand = FAST, rule: TopicRule = PULL) -> Pair:
    return Pair(rules=(rule, *RULES), bands=(band,))


def wanted(pair: Pair) -> list[Wanted]:
    return [e for e in pair.robot.events if isinstance(e, Wanted)]


# Budgets.


def test_all_of_the_rate_is_for_the_highest_tier_and_what_is_left_for_those_below() -> None:
    demand = Demand()
    for i in range(40):
        demand.on_sent(2, 5_000, i * 100 * MS)  # 400 kbit/s
    assert demand.budget_bytes(1, 1_000_000, S, 4 * S - 1) == 125_000
    assert demand.budget_bytes(2, 1_000_000, S, 4 * S - 1) == 125_000
    assert demand.budget_bytes(3, 1_000_000, S, 4 * S - 1) == 75_000
    assert demand.budget_bytes(3, 1_000_000, S // 2, 4 * S - 1) == 37_500
    assert demand.budget_bytes(3, 100_000, S, 4 * S - 1) == 256
    assert demand.budget_bytes(3, 1_000_000, S, 9 * S) == 125_000


def test_a_publishers_budget_follows_the_rate_of_the_link() -> None:
    budgets = []
    for band in (FAST, THIN):
        pair = Pair(bands=(band,))
        pair.offer(pair.robot, "robot/perception/a", b"x")
        budgets.append(pair.robot.endpoint.demands(pair.robot.local_ns(pair.now_ns))["robot/perception/a"])
    assert budgets == [(118_750, S), (11_875, S)]


def test_a_budget_is_never_larger_than_a_message_may_be() -> None:
    rule = TopicRule("**", DEFAULT_CLASSES["bulk"], min_period_ns=1000 * S)
    pair = Pair(rules=(rule,))
    pair.offer(pair.robot, "robot/log", b"x")
    assert pair.robot.endpoint.demands(pair.robot.local_ns(pair.now_ns))["robot/log"][0] == 4_000_000


# Topics that are asked for.


def test_a_pull_topic_is_asked_for_once_a_period_while_there_is_room() -> None:
    pair = pull_pair()
    pair.forget_history()
    for _ in range(100):
        before = len(wanted(pair))
        pair.advance(100 * MS)
        if len(wanted(pair)) > before:
            pair.offer(pair.robot, IMAGE, b"i" * 500)
    assert 9 <= len(wanted(pair)) <= 11
    assert pair.operator.payloads == [b"i" * 500] * len(wanted(pair))
    assert all(w.budget_bytes >= 256 for w in wanted(pair))


def test_it_is_not_asked_for_while_higher_tiers_take_the_link() -> None:
    pair = pull_pair(THIN)
    pair.advance(3 * S)
    pair.forget_history()
    pair.offer(pair.robot, "robot/plan/large", bytes(60_000))  # 5 s of the link
    pair.advance(4 * S)
    assert wanted(pair) == []
    pair.advance(6 * S)
    assert wanted(pair)


def test_the_answer_leaves_at_once_and_nothing_asks_before_it_has() -> None:
    pair = pull_pair(THIN)
    pair.forget_history()
    pair.advance(5 * S)
    pair.offer(pair.robot, IMAGE, bytes(30_000))  # 2.5 s
    count = len(wanted(pair))
    pair.advance(2 * S)
    assert len(wanted(pair)) == count
    sizes = [len(f.data) for f in pair.robot.frames(MessageFrame) if isinstance(f, MessageFrame)]
    assert sum(sizes) > 15_000


def test_a_question_without_an_answer_is_asked_anew_after_its_time_and_not_before() -> None:
    pair = pull_pair()
    pair.forget_history()
    at_ns = []
    for _ in range(1000):
        before = len(wanted(pair))
        pair.step()
        if len(wanted(pair)) > before:
            at_ns.append(pair.now_ns)
        if pair.now_ns > 20 * S:
            break
    gaps_ns = [b - a for a, b in itertools.pairwise(at_ns)]
    assert len(gaps_ns) >= 5
    assert min(gaps_ns) >= PULL_TIMEOUT_NS
    assert max(gaps_ns) < PULL_TIMEOUT_NS + 200 * MS


def test_the_budget_of_a_question_leaves_room_for_higher_tiers() -> None:
    pair = pull_pair()
    for _ in range(50):
        pair.offer(pair.robot, "robot/state/a", bytes(5_000))  # 400 kbit/s of 950
        pair.advance(100 * MS)
    assert wanted(pair)[-1].budget_bytes == pytest.approx(550_000 / 8, rel=0.05)


# What became of an answer.


@pytest.mark.parametrize("size", [100, 20_000])
def test_who_answers_is_told_when_it_has_left_and_when_it_is_there(size: int) -> None:
    pair = pull_pair()
    pair.offer(pair.robot, IMAGE, bytes(size), tag=7)
    pair.advance(2 * S)
    assert pair.robot.stages(7) == ["queued", "sent", "delivered"]
    assert len(pair.operator.payloads) == 1


@pytest.mark.parametrize("lost", [1, 3])
def test_an_answer_of_which_a_part_is_lost_is_lost_and_the_next_is_not(lost: int) -> None:
    pair = pull_pair()
    large = itertools.count()
    pair.robot.loses = lambda datagram: len(datagram) > 1_000 and next(large) < lost
    pair.offer(pair.robot, IMAGE, bytes(20_000), tag=7)
    pair.advance(3 * S)
    assert pair.robot.stages(7)[-1] == "lost" and pair.robot.stages(7).count("lost") == 1
    pair.offer(pair.robot, IMAGE, bytes(3_000), tag=8)
    pair.advance(2 * S)
    assert pair.robot.stages(8)[-1] == "delivered"
    assert [len(payload) for payload in pair.operator.payloads] == [3_000]


def test_an_answer_under_parity_is_delivered_although_a_part_is_lost() -> None:
    chance = random.Random(3)
    pair = pull_pair()
    pair.robot.loses = lambda datagram: chance.random() < 0.1
    fates: dict[str, int] = {}
    for tag in range(1, 40):
        before = len(pair.operator.payloads)
        pair.offer(pair.robot, IMAGE, bytes(8_000), tag=tag)
        pair.advance(2 * S)
        arrived = len(pair.operator.payloads) > before
        last = pair.robot.stages(tag)[-1]
        assert last == ("delivered" if arrived else "lost"), tag
        fates[last] = fates.get(last, 0) + 1
    assert fates["delivered"] > 30


def test_a_peer_that_restarts_midway_gets_the_answer_anew_and_it_counts_once() -> None:
    pair = pull_pair(THIN)
    pair.offer(pair.robot, IMAGE, bytes(20_000), tag=7)
    pair.advance(500 * MS)
    pair.restart(pair.operator)
    pair.advance(15 * S)
    assert pair.robot.stages(7).count("sent") == 1
    assert (pair.robot.stages(7)[-1] == "delivered") == bool(pair.operator.payloads)


# Guaranteed shares.


def saturate(pair: Pair, seconds: int, sizes: dict[str, int]) -> dict[str, int]:
    """Keep these topics busy; message bytes that arrived of each."""
    for _ in range(seconds * 20):
        for name, size in sizes.items():
            pair.offer(pair.robot, f"robot/{name}", bytes(size))
        pair.advance(50 * MS)
    ledgers = pair.robot.endpoint.sent_ledgers()
    return {name: ledgers[f"robot/{name}"].sent_bytes for name in sizes}


GREEDY = TopicRule(
    "robot/greedy", replace(DEFAULT_CLASSES["heartbeat"], keep=Keep.ALL, always_send=False, depth=64)
)


@pytest.mark.parametrize("band", [FAST, THIN], ids=["fast", "thin"])
@pytest.mark.parametrize("share", [0.05, 0.2])
def test_a_guaranteed_share_is_given_within_one_per_cent_for_a_minute(band: PresetBand, share: float) -> None:
    """A guarantee holds while tier 1 saturates the link."""
    pair = Pair(rules=(GREEDY, *RULES), bands=(band,), guaranteed={5: share})
    got = saturate(pair, 60, {"greedy": 7_000, "bulk/log": 2_000})
    assert got["bulk/log"] / sum(got.values()) == pytest.approx(share, abs=0.01)


def test_without_a_guarantee_lower_tiers_get_nothing() -> None:
    pair = Pair(rules=(GREEDY, *RULES))
    got = saturate(pair, 10, {"greedy": 7_000, "bulk/log": 2_000})
    assert got["bulk/log"] == 0


@settings(max_examples=8)
@given(st.lists(st.sampled_from([0.5, 1.0, 2.0, 5.0]), min_size=2, max_size=4))
def test_topics_of_a_tier_share_the_link_by_weight_whatever_their_sizes(weights: list[float]) -> None:
    rules = tuple(
        TopicRule(f"robot/t{i}", replace(DEFAULT_CLASSES["bulk"], max_parity_ratio=0.0), weight=weight)
        for i, weight in enumerate(weights)
    )
    pair = Pair(rules=rules)
    got = saturate(pair, 20, {f"t{i}": 7_000 + 900 * i for i in range(len(weights))})
    for i, weight in enumerate(weights):
        assert got[f"t{i}"] / sum(got.values()) == pytest.approx(weight / sum(weights), abs=0.02)


def test_an_emergency_is_there_first_whatever_is_guaranteed_and_saturated() -> None:
    pair = Pair(rules=(GREEDY, *RULES), bands=(THIN,), guaranteed={5: 0.5})
    saturate(pair, 3, {"greedy": 2_000, "bulk/log": 2_000})
    pair.forget_history()
    pair.offer(pair.robot, "robot/emergency", b"stop")
    pair.advance(THIN.one_way_delay_ns + 1 * MS)
    assert b"stop" in pair.operator.payloads

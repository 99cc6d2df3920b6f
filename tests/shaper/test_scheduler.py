from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shaper.queues import TopicQueue
from shaper.scheduler import Scheduler
from shaper.traffic_class import Keep, TopicRule, TrafficClass

LARGEST = 1000  # bytes of a message in the properties


def queue_of(name: str, tier: int, always_send: bool = False, weight: float = 1.0) -> TopicQueue:
    traffic_class = TrafficClass(name, tier, Keep.ALL, ttl_ns=1 << 60, depth=10_000, always_send=always_send)
    return TopicQueue(name, TopicRule(name, traffic_class, weight=weight))


def offer(scheduler: Scheduler, queue: TopicQueue, count: int = 1, size: int = 100) -> None:
    for _ in range(count):
        queue.offer(bytes(size), "", 0, 0)
    scheduler.activate(queue)


def serve(scheduler: Scheduler, at_most: int = 1 << 30, **conditions: bool) -> str | None:
    """Send a datagram's worth of whoever is next, as Outgoing does; its key."""
    queue = scheduler.next_queue(**conditions)
    if queue is None:
        return None
    piece = queue.next_piece(0)
    assert piece is not None
    count = min(piece.length, at_most)
    queue.sent(piece, count)
    scheduler.on_sent(queue, count)
    if not queue.message_under_way:
        scheduler.message_done(queue)
    return queue.key


def test_an_idle_scheduler_has_nobody_to_serve() -> None:
    assert Scheduler().next_queue() is None


# Fairness within a tier is in bytes, no longer turn by turn: with equal messages the two are the same.


def test_topics_of_a_tier_with_equal_messages_take_turns() -> None:
    scheduler = Scheduler()
    for name, count in (("a", 3), ("b", 1), ("c", 2)):
        offer(scheduler, queue_of(name, 3), count)
    assert [serve(scheduler) for _ in range(7)] == ["a", "b", "c", "a", "c", "a", None]


def test_a_topic_that_falls_idle_and_comes_back_goes_to_the_end_of_the_line() -> None:
    scheduler = Scheduler()
    a, b = queue_of("a", 3), queue_of("b", 3)
    offer(scheduler, a)
    offer(scheduler, b, 2)
    assert serve(scheduler) == "a"
    offer(scheduler, a)
    assert [serve(scheduler) for _ in range(3)] == ["b", "a", "b"]


def test_after_a_large_message_the_others_have_as_much_before_the_next() -> None:
    scheduler = Scheduler()
    offer(scheduler, queue_of("large", 3), 3, size=1000)
    offer(scheduler, queue_of("small", 3), 30, size=100)
    order = [serve(scheduler) for _ in range(33)]
    assert order == (["large"] + ["small"] * 10) * 3


def test_an_idle_topic_hoards_nothing() -> None:
    scheduler = Scheduler()
    busy, idle = queue_of("busy", 3), queue_of("idle", 3)
    offer(scheduler, idle)
    offer(scheduler, busy, 200)
    for _ in range(101):
        serve(scheduler)
    offer(scheduler, idle, 50)
    assert Counter(serve(scheduler) for _ in range(20)) == {"busy": 10, "idle": 10}


def test_a_message_in_parts_keeps_its_tiers_turn_until_it_is_done() -> None:
    scheduler = Scheduler()
    offer(scheduler, queue_of("a", 3), size=400)
    offer(scheduler, queue_of("b", 3), size=100)
    assert [serve(scheduler, at_most=100) for _ in range(5)] == ["a"] * 4 + ["b"]


def test_a_higher_tier_comes_between_the_parts_of_a_message_and_then_it_goes_on() -> None:
    scheduler = Scheduler()
    offer(scheduler, queue_of("image", 4), 2, size=300)
    offer(scheduler, queue_of("other image", 4), size=300)
    assert serve(scheduler, at_most=100) == "image"
    offer(scheduler, queue_of("beat", 1))
    assert [serve(scheduler, at_most=100) for _ in range(4)] == ["beat", "image", "image", "other image"]


@given(
    acts=st.lists(
        st.one_of(st.integers(0, 11), st.sampled_from(["any", "holding", "emergency"])), max_size=100
    )
)
def test_nobody_is_served_while_a_higher_tier_waits(acts: list[int | str]) -> None:
    scheduler = Scheduler()
    queues = [queue_of(f"{tier}{i}", tier, always_send=i == 1) for tier in range(4) for i in range(3)]
    for act in acts:
        if isinstance(act, int):
            offer(scheduler, queues[act])
            continue
        may = {
            q.key: q.rule.traffic_class.tier
            for q in queues
            if q.waiting
            and (act != "holding" or q.rule.traffic_class.always_send)
            and (act != "emergency" or q.rule.traffic_class.tier == 0)
        }
        served = serve(scheduler, only_always_send=act == "holding", only_emergency=act == "emergency")
        if served is None:
            assert not may
            continue
        assert may[served] == min(may.values())


@given(
    st.lists(
        st.tuples(
            st.sampled_from([0.001, 0.5, 1.0, 3.0, 1000.0]), st.lists(st.integers(1, LARGEST), min_size=1)
        ),
        min_size=2,
        max_size=5,
    ),
    st.sampled_from([100, 1 << 30]),
)
def test_while_two_topics_have_something_their_bytes_are_as_their_weights(
    topics: list[tuple[float, list[int]]], datagram_bytes: int
) -> None:
    """Start-time fair queueing: by weight they differ by no more than one message of each."""
    scheduler, queues, sent = Scheduler(), [], Counter[str]()
    for i, (weight, sizes) in enumerate(topics):
        queues.append(queue_of(str(i), 3, weight=weight))
        for n in range(200):
            offer(scheduler, queues[i], size=sizes[n % len(sizes)])
    for _ in range(300):
        before = {q.key: q.ledger.sent_bytes for q in queues}
        assert serve(scheduler, datagram_bytes) is not None
        for q in queues:
            sent[q.key] += q.ledger.sent_bytes - before[q.key]
        if any(q.empty for q in queues):
            break
        shares = [(sent[q.key] / q.rule.weight, LARGEST / q.rule.weight) for q in queues]
        for share, message in shares:
            for other, other_message in shares:
                assert abs(share - other) <= (message + other_message) * (1 + 1e-6)


@pytest.mark.parametrize("weight", [1.0, 1000.0])
def test_the_smallest_messages_starve_nobody_whatever_their_weight(weight: float) -> None:
    scheduler = Scheduler()
    offer(scheduler, queue_of("a", 3), 5000, size=1)
    offer(scheduler, queue_of("tiny", 3, weight=weight), 5000, size=1)
    served = Counter(serve(scheduler) for _ in range(3000))
    assert served["a"] >= 2


@pytest.mark.parametrize("share", [0.05, 0.3])
@pytest.mark.parametrize("datagram_bytes", [100, 1172])
def test_a_guaranteed_tier_gets_its_share_whatever_those_above_it_want(
    share: float, datagram_bytes: int
) -> None:
    scheduler = Scheduler({5: share})
    greedy, modest = queue_of("greedy", 1), queue_of("modest", 5)
    for _ in range(2000):
        offer(scheduler, greedy, size=700)
        offer(scheduler, modest, size=1900)
        serve(scheduler, datagram_bytes)
    total = greedy.ledger.sent_bytes + modest.ledger.sent_bytes
    assert modest.ledger.sent_bytes / total == pytest.approx(share, abs=0.01)


def test_a_guarantee_is_not_saved_up_while_there_is_nothing_to_send() -> None:
    scheduler = Scheduler({5: 0.5})
    offer(scheduler, queue_of("greedy", 1), 400)
    late = queue_of("late", 5)
    offer(scheduler, late)
    for _ in range(100):
        serve(scheduler)
    offer(scheduler, late, 100)
    served = Counter(serve(scheduler) for _ in range(40))
    assert served["greedy"] >= 19


def test_an_emergency_comes_before_a_guarantee_where_only_emergencies_may_leave() -> None:
    scheduler = Scheduler({5: 0.9})
    offer(scheduler, queue_of("owed", 5), 10)
    offer(scheduler, queue_of("greedy", 1))
    assert serve(scheduler) == "greedy"
    offer(scheduler, queue_of("stop", 0))
    assert serve(scheduler, only_emergency=True) == "stop"


def test_an_emergency_comes_before_a_guarantee_that_is_behind() -> None:
    scheduler = Scheduler({5: 0.9})
    offer(scheduler, queue_of("owed", 5), 10)
    offer(scheduler, queue_of("greedy", 1))
    assert serve(scheduler) == "greedy"
    offer(scheduler, queue_of("stop", 0))
    assert serve(scheduler) == "stop"


def test_while_the_link_is_held_the_beats_of_a_tier_take_turns() -> None:
    scheduler = Scheduler()
    offer(scheduler, queue_of("bulk", 3))
    for name in ("beat a", "beat b"):
        offer(scheduler, queue_of(name, 3, always_send=True), 2)
    assert [serve(scheduler, only_always_send=True) for _ in range(5)] == ["beat a", "beat b"] * 2 + [None]


def test_while_the_link_is_held_only_always_send_is_served_and_the_rest_keep_their_place() -> None:
    scheduler = Scheduler()
    offer(scheduler, queue_of("bulk", 3))
    offer(scheduler, queue_of("beat", 3, always_send=True), 2)
    assert serve(scheduler, only_always_send=True) == "beat"
    assert [serve(scheduler) for _ in range(3)] == ["bulk", "beat", None]

from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from shaper.queues import Departure, TopicQueue
from shaper.scheduler import Scheduler
from shaper.traffic_class import Keep, TopicRule, TrafficClass


def queue_of(name: str, tier: int, always_send: bool = False) -> TopicQueue:
    traffic_class = TrafficClass(name, tier, Keep.ALL, ttl_ns=1 << 60, depth=1000, always_send=always_send)
    return TopicQueue(name, TopicRule(name, traffic_class))


def offer(scheduler: Scheduler, queue: TopicQueue, count: int = 1) -> None:
    for _ in range(count):
        queue.offer(b"", "", 0, 0)
    scheduler.activate(queue)


def serve(scheduler: Scheduler, **conditions: bool) -> str | None:
    queue = scheduler.next_queue(**conditions)
    if queue is None:
        return None
    queue.take(0)
    scheduler.message_done(queue)
    return queue.key


def test_an_idle_scheduler_has_nobody_to_serve() -> None:
    assert Scheduler().next_queue() is None


def test_topics_of_a_tier_take_turns() -> None:
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


def test_a_message_in_parts_keeps_its_place_until_it_is_done() -> None:
    scheduler = Scheduler()
    a, b = queue_of("a", 3), queue_of("b", 3)
    a.departing = Departure(b"1234", "", 0, 0, False, offset=2)
    scheduler.activate(a)
    offer(scheduler, b)
    assert scheduler.next_queue() is a
    assert scheduler.next_queue() is a
    a.departing = None
    scheduler.message_done(a)
    assert scheduler.next_queue() is b


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
        may = [
            q
            for q in queues
            if q.waiting
            and (act != "holding" or q.rule.traffic_class.always_send)
            and (act != "emergency" or q.rule.traffic_class.tier == 0)
        ]
        served = scheduler.next_queue(only_always_send=act == "holding", only_emergency=act == "emergency")
        if served is None:
            assert not may
            continue
        assert served in may
        assert served.rule.traffic_class.tier == min(q.rule.traffic_class.tier for q in may)
        served.take(0)
        scheduler.message_done(served)


@given(st.lists(st.integers(1, 8), min_size=2, max_size=6))
def test_while_all_have_something_no_topic_is_served_twice_more_than_another(counts: list[int]) -> None:
    scheduler = Scheduler()
    for i, count in enumerate(counts):
        offer(scheduler, queue_of(str(i), 3), count)
    served = Counter[str]()
    for _ in range(len(counts) * min(counts)):
        served[str(serve(scheduler))] += 1
        busy = [served[str(i)] for i in range(len(counts))]
        assert max(busy) - min(busy) <= 1


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

import random
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shaper.queues import Departure, TopicQueue
from shaper.traffic_class import Keep, TopicRule, TrafficClass

MS = 1_000_000
S = 1_000_000_000

LATEST = TrafficClass("state", tier=3, keep=Keep.LATEST, ttl_ns=2 * S)
FIFO = TrafficClass("command", tier=2, keep=Keep.ALL, ttl_ns=2 * S, depth=4)


def queue_of(traffic_class: TrafficClass, min_period_ns: int = 0) -> TopicQueue:
    return TopicQueue("robot/a", TopicRule("robot/a", traffic_class, min_period_ns))


def take(queue: TopicQueue, now_ns: int) -> Departure | None:
    """Send the next message whole."""
    piece = queue.next_piece(now_ns)
    if piece is None:
        return None
    queue.sent(piece, piece.length)
    return piece.departure


def test_a_newer_sample_supersedes_the_queued_one() -> None:
    queue = queue_of(LATEST)
    assert queue.offer(b"old", "", 0, 0)
    assert not queue.offer(b"new", "", 1, 1)

    taken = take(queue, 2)
    assert taken is not None
    assert (taken.data, taken.capture_ns) == (b"new", 1)
    assert queue.ledger.superseded == 1
    assert queue.empty


def test_a_fifo_keeps_order_and_drops_the_oldest_when_full() -> None:
    queue = queue_of(FIFO)
    for i in range(6):
        queue.offer(b"%d" % i, "", i, i)
    taken = [take(queue, 10) for _ in range(4)]
    assert [t.data for t in taken if t] == [b"2", b"3", b"4", b"5"]
    assert queue.ledger.overflow == 2
    assert take(queue, 10) is None


def test_the_expired_ones_are_passed_over_and_counted() -> None:
    queue = queue_of(FIFO)
    for capture_ns in (0, 1, 5):
        queue.offer(b"%d" % capture_ns, "", capture_ns, 5)
    taken = take(queue, 2 * S + 2)
    assert taken is not None and taken.data == b"5"
    assert queue.ledger.expired == 2


def test_a_message_is_worth_sending_up_to_its_ttl_and_no_longer() -> None:
    for late_ns, is_sent in ((0, True), (1, False)):
        queue = queue_of(FIFO)
        queue.offer(b"", "", 100, 100)
        assert (take(queue, 100 + 2 * S + late_ns) is not None) == is_sent


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("jitter_ratio", [0.0, 0.1, 0.24])
@pytest.mark.parametrize("traffic_class", [LATEST, FIFO], ids=["latest", "all"])
def test_a_source_at_just_the_asked_rate_loses_nothing_to_jitter(
    traffic_class: TrafficClass, jitter_ratio: float, seed: int
) -> None:
    generator = random.Random(seed)
    queue = queue_of(traffic_class, min_period_ns=200 * MS)
    for i in range(500):
        now_ns = i * 200 * MS + int(generator.uniform(-jitter_ratio, jitter_ratio) * 200 * MS)
        queue.offer(b"", "", now_ns, now_ns)
        assert take(queue, now_ns) is not None
    assert queue.ledger.decimated == 0


@given(
    gaps_ns=st.lists(st.integers(0, 500 * MS), min_size=1, max_size=200),
    period_ns=st.integers(1, 400 * MS),
    keep=st.sampled_from([Keep.LATEST, Keep.ALL]),
)
def test_decimation_never_exceeds_the_asked_rate_in_the_long_run(
    gaps_ns: list[int], period_ns: int, keep: Keep
) -> None:
    queue = queue_of(replace(FIFO, keep=keep), min_period_ns=period_ns)
    now_ns, accepted_ns = 0, []
    for gap_ns in gaps_ns:
        now_ns += gap_ns
        if queue.offer(b"", "", now_ns, now_ns):
            accepted_ns.append(now_ns)
        take(queue, now_ns)
    for n, last_ns in enumerate(accepted_ns):
        # From any accepted sample on: one per period, and once half a period early.
        for m, first_ns in enumerate(accepted_ns[: n + 1]):
            assert (n - m) * period_ns <= last_ns - first_ns + period_ns // 2


def test_a_fast_source_is_decimated_to_the_asked_rate() -> None:
    queue = queue_of(FIFO, min_period_ns=200 * MS)
    for i in range(3333):
        queue.offer(b"", "", i * 3 * MS, i * 3 * MS)
        take(queue, i * 3 * MS)
    assert 49 <= queue.ledger.offered - queue.ledger.decimated <= 51


def test_a_waiting_sample_is_replaced_whatever_the_decimation_says() -> None:
    queue = queue_of(LATEST, min_period_ns=S)
    queue.offer(b"old", "", 0, 0)
    queue.offer(b"fresh", "", 3 * MS, 3 * MS)
    taken = take(queue, 3 * MS)
    assert taken is not None and taken.data == b"fresh"
    assert not queue.offer(b"early", "", 6 * MS, 6 * MS)
    assert queue.ledger.decimated == 1


@given(
    keep=st.sampled_from([Keep.LATEST, Keep.ALL]),
    period_ns=st.sampled_from([0, 100 * MS]),
    acts=st.lists(st.tuples(st.booleans(), st.integers(0, 900 * MS), st.integers(0, 3 * S)), max_size=80),
)
def test_every_offered_message_is_accounted_for(
    keep: Keep, period_ns: int, acts: list[tuple[bool, int, int]]
) -> None:
    queue = queue_of(replace(FIFO, keep=keep), min_period_ns=period_ns)
    now_ns = 5 * S
    for is_offer, gap_ns, age_ns in acts:
        now_ns += gap_ns
        if is_offer:
            queue.offer(b"", "", now_ns - age_ns, now_ns)
        else:
            take(queue, now_ns)
        assert queue.ledger.queued == len(queue.waiting)
        assert len(queue.waiting) <= (1 if keep is Keep.LATEST else FIFO.depth)

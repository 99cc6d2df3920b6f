import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shaper.fragments import PART_OVERHEAD_BYTES, Reassembled, Reassembler

S = 1_000_000_000
KEY = (1, 7)


def reassembler(max_bytes: int = 1_000_000) -> Reassembler:
    return Reassembler(max_bytes, max_message_bytes=100_000, max_wait_ns=10 * S)


def cut(message: bytes, at: set[int]) -> list[tuple[int, bytes]]:
    edges = [0, *sorted(a for a in at if 0 < a < len(message)), len(message)]
    return [(a, message[a:b]) for a, b in itertools.pairwise(edges)]


@given(st.data())
def test_any_split_in_any_order_with_duplicates_comes_together_once(data: st.DataObject) -> None:
    message = data.draw(st.binary(min_size=1, max_size=200))
    parts = cut(message, data.draw(st.sets(st.integers(1, 199), max_size=12)))
    repeated = data.draw(st.lists(st.sampled_from(parts), max_size=10))
    last = data.draw(st.sampled_from(parts))
    before = [p for p in parts if p is not last]
    arrivals = data.draw(st.permutations(before + [p for p in repeated if p[0] != last[0]]))
    r = reassembler()
    for sent_us, (offset, part) in enumerate(arrivals, start=5):
        assert r.add(KEY, offset, len(message), part, sent_us, 0) is None

    whole = r.add(KEY, last[0], len(message), last[1], sent_us=4, now_ns=0)

    assert whole == Reassembled(message, 4)
    assert (len(r), r.held_bytes, r.given_up) == (0, 0, 0)


def test_the_first_departure_of_any_part_is_told() -> None:
    r = reassembler()
    r.add(KEY, 3, 6, b"def", sent_us=50, now_ns=60)
    assert r.add(KEY, 0, 6, b"abc", sent_us=80, now_ns=90) == Reassembled(b"abcdef", 50)


def test_messages_of_different_topics_and_numbers_do_not_mix() -> None:
    r = reassembler()
    for key in ((1, 7), (1, 8), (2, 7)):
        assert r.add(key, 0, 4, b"%d%d" % key, 0, 0) is None
    assert r.add((1, 8), 2, 4, b"..", 0, 0) == Reassembled(b"18..", 0)
    assert len(r) == 2


@pytest.mark.parametrize(
    "contradiction",
    [(2, 8, b"cd"), (0, 5, b"ab")],
    ids=["another total", "another total at a held offset"],
)
def test_a_part_that_contradicts_what_is_held_drops_the_message(
    contradiction: tuple[int, int, bytes],
) -> None:
    r = reassembler()
    r.add(KEY, 0, 4, b"ab", 0, 0)
    offset, total, part = contradiction
    assert r.add(KEY, offset, total, part, 0, 0) is None
    assert (len(r), r.held_bytes, r.given_up) == (0, 0, 1)


def test_where_parts_overlap_what_came_first_is_kept() -> None:
    """A part that is repeated may be cut elsewhere than before; its bytes are the same bytes."""
    r = reassembler()
    r.add(KEY, 1, 6, b"bcd", 0, 0)
    assert r.add(KEY, 0, 6, b"aXXX", 0, 0) is None
    assert r.add(KEY, 3, 6, b"Xef", 0, 0) == Reassembled(b"abcdef", 0)


def test_parts_with_a_gap_and_an_overlap_of_the_same_size_are_no_message_yet() -> None:
    r = reassembler()
    r.add(KEY, 0, 6, b"abc", 0, 0)
    assert r.add(KEY, 2, 6, b"cde", 0, 0) is None
    assert (len(r), r.given_up) == (1, 0)
    assert r.add(KEY, 5, 6, b"f", 0, 0) == Reassembled(b"abcdef", 0)


@given(st.data())
def test_any_cuts_of_a_message_in_any_order_come_together(data: st.DataObject) -> None:
    """Sent once cut one way, lost in part, and sent again cut another way."""
    message = data.draw(st.binary(min_size=1, max_size=100))
    cuts = [cut(message, data.draw(st.sets(st.integers(1, 99), max_size=8))) for _ in range(3)]
    arrivals = data.draw(st.permutations([part for parts in cuts for part in parts]))
    r = reassembler()
    wholes = [r.add(KEY, offset, len(message), part, 0, 0) for offset, part in arrivals]
    assert [w.data for w in wholes if w] == [message]
    assert r.held_bytes == 0


def test_what_is_late_of_a_whole_message_starts_nothing_anew() -> None:
    r = reassembler()
    r.add(KEY, 0, 4, b"ab", 0, 0)
    assert r.add(KEY, 2, 4, b"cd", 0, 0) is not None
    assert r.add(KEY, 0, 4, b"ab", 0, 0) is None
    assert (len(r), r.held_bytes) == (0, 0)


def test_a_message_that_declares_more_than_the_limit_takes_no_memory() -> None:
    r = reassembler()
    assert r.add(KEY, 0, 100_001, b"a" * 1000, 0, 0) is None
    assert (len(r), r.held_bytes, r.given_up) == (0, 0, 1)


def test_an_unfinished_message_is_given_up_after_its_time() -> None:
    r = reassembler()
    r.add((1, 1), 0, 4, b"ab", 0, now_ns=0)
    r.add((1, 2), 0, 4, b"ab", 0, now_ns=10 * S)
    assert len(r) == 2
    r.add((1, 3), 0, 4, b"ab", 0, now_ns=10 * S + 1)
    assert (len(r), r.given_up) == (2, 1)
    assert r.add((1, 1), 2, 4, b"cd", 0, now_ns=10 * S + 2) is None


def test_the_oldest_unfinished_message_gives_way() -> None:
    r = reassembler(max_bytes=3 * (PART_OVERHEAD_BYTES + 10))
    for number in range(4):
        r.add((1, number), 0, 20, b"x" * 10, 0, 0)
    assert (len(r), r.given_up) == (3, 1)
    assert r.add((1, 0), 10, 20, b"y" * 10, 0, 0) is None
    assert r.add((1, 3), 10, 20, b"y" * 10, 0, 0) is not None


def test_clear_forgets_everything() -> None:
    r = reassembler()
    r.add(KEY, 0, 4, b"ab", 0, 0)
    r.clear()
    assert (len(r), r.held_bytes) == (0, 0)


@settings(max_examples=60)
@given(
    max_bytes=st.integers(200, 5_000),
    flood=st.lists(
        st.tuples(
            st.integers(0, 3),
            st.integers(0, 20),
            st.integers(0, 2000),
            st.integers(1, 400),
            st.integers(1, 2400),
        ),
        max_size=150,
    ),
)
def test_no_flood_of_parts_holds_more_than_the_limit(
    max_bytes: int, flood: list[tuple[int, int, int, int, int]]
) -> None:
    r = reassembler(max_bytes)
    for now_ns, (topic, number, offset, size, total) in enumerate(flood):
        r.add((topic, number), offset, total, bytes(size), 0, now_ns * S // 10)
        assert r.held_bytes <= max_bytes
        assert r.held_bytes >= len(r) * (PART_OVERHEAD_BYTES + 1)
    actually_held = sum(p.held_bytes for p in r._partials.values())
    assert actually_held == r.held_bytes


def test_no_more_messages_are_unfinished_than_may_be() -> None:
    reassembler = Reassembler(1_000_000, 1000, 1_000_000_000, max_messages=10)
    for number in range(100):
        assert reassembler.add((0, number), 0, 100, b"part", 0, 0) is None
        assert len(reassembler) <= 10
    assert reassembler.given_up == 90

"""A state that both sides share: nothing crosses while nothing changes, and they converge."""

from __future__ import annotations

import contextlib

from hypothesis import given, settings
from hypothesis import strategies as st

from messages.keyed_entries import REST, split_entries
from shaper.errors import DecodeError
from shaper.frames import IP_UDP_BYTES, LedgerFrame, MessageFrame
from shaper.shared_state import decode_entries, encode_entries
from shaper.traffic_class import DEFAULT_CLASSES, Entries, TopicRule
from tests.messages.test_keyed_entries import CPU, ITEMS, NAME, item, number
from tests.shaper.pair import MS, RULES, Pair, S, Side
from tests.shaper.unreliable import FATES, suffer

STATUS = "robot/processes"
TABLE = TopicRule(
    STATUS,
    DEFAULT_CLASSES["status"],
    entries=Entries(ITEMS, NAME, ignored=frozenset({CPU}), ignored_outside=frozenset({1})),
)
WHOLE = TopicRule("robot/mode", DEFAULT_CLASSES["status"])


def pair_of() -> Pair:
    return Pair(rules=(TABLE, WHOLE, *RULES))


def table(states: dict[int, int], tick: int = 0) -> bytes:
    """Processes by number with their states; the clock and the processor's load differ every time."""
    return number(1, tick) + b"".join(item(b"process %d" % n, tick + n, s) for n, s in states.items())


def states_of(payload: bytes) -> dict[int, bytes]:
    entries = split_entries(payload, ITEMS, NAME, {CPU}, {1})
    return {name: entry.compared for name, entry in entries.items()}


def frames(side: Side) -> list[MessageFrame]:
    return [f for f in side.frames(MessageFrame) if isinstance(f, MessageFrame)]


# Convergence.

STATES = st.dictionaries(st.integers(0, 5), st.integers(0, 2), max_size=6)


@settings(max_examples=60)
@given(
    FATES,
    st.lists(
        st.one_of(STATES, st.sampled_from(["robot restarts", "operator restarts"])), min_size=1, max_size=25
    ),
    st.sampled_from([10 * MS, 120 * MS]),
)
def test_after_loss_reordering_and_restarts_both_sides_have_the_same_state(
    fates: list[str], acts: list[dict[int, int] | str], gap_ns: int
) -> None:
    pair = pair_of()
    suffer(pair, fates)
    last: dict[int, int] = {}
    for tick, act in enumerate(acts):
        if act == "robot restarts":
            pair.restart(pair.robot)
        elif act == "operator restarts":
            pair.restart(pair.operator)
        elif isinstance(act, dict):
            last = act
        pair.offer(pair.robot, STATUS, table(last, tick))
        pair.advance(gap_ns)
    pair.advance(20 * S)
    assert states_of(pair.operator.payloads[-1]) == states_of(table(last))


@settings(max_examples=40)
@given(FATES, st.lists(st.sampled_from([b"walk", b"stand", b"fall"]), min_size=1, max_size=20))
def test_a_message_that_is_no_table_converges_as_a_whole(fates: list[str], modes: list[bytes]) -> None:
    pair = pair_of()
    suffer(pair, fates)
    for mode in modes:
        pair.offer(pair.robot, "robot/mode", mode)
        pair.advance(70 * MS)
    pair.advance(20 * S)
    assert pair.operator.payloads[-1] == modes[-1]


def test_what_is_no_protobuf_under_a_rule_for_tables_crosses_as_a_whole() -> None:
    pair = pair_of()
    for payload in (b"\xff\xff", b"\x0b", table({1: 1})):
        pair.offer(pair.robot, STATUS, payload)
        pair.advance(500 * MS)
    assert pair.operator.payloads[:2] == [b"\xff\xff", b"\x0b"]
    assert states_of(pair.operator.payloads[-1]) == states_of(table({1: 1}))


def test_an_entry_that_vanishes_vanishes_there() -> None:
    pair = pair_of()
    pair.offer(pair.robot, STATUS, table({1: 1, 2: 1, 3: 1}))
    pair.advance(500 * MS)
    pair.offer(pair.robot, STATUS, table({1: 1, 3: 1}))
    pair.advance(500 * MS)
    assert states_of(pair.operator.payloads[-1]) == states_of(table({1: 1, 3: 1}))
    assert len(frames(pair.robot)[-1].data) < 20


def test_a_state_that_goes_and_comes_back_before_it_could_leave_crosses_not_at_all() -> None:
    pair = pair_of()
    pair.offer(pair.robot, STATUS, table({1: 1}))
    pair.advance(1 * S)
    pair.forget_history()
    for state in (2, 1):
        pair.offer(pair.robot, STATUS, table({1: state}), pumped=False)
    pair.pump(pair.robot)
    pair.advance(500 * MS)
    assert frames(pair.robot) == []
    assert pair.robot.endpoint.sent_ledgers()[STATUS].queued == 0


def test_a_state_larger_than_a_datagram_crosses_and_then_only_what_changes() -> None:
    pair = pair_of()
    states = {n: n * 7919 for n in range(400)}
    pair.offer(pair.robot, STATUS, table(states))
    pair.advance(2 * S)
    states[17] += 1
    pair.forget_history()
    pair.offer(pair.robot, STATUS, table(states, 1))
    pair.advance(500 * MS)
    assert sum(len(f.data) for f in frames(pair.robot)) < 60
    assert states_of(pair.operator.payloads[-1]) == states_of(table(states))


# Nothing while nothing changes.


def test_a_hundred_processes_that_do_not_change_cost_nothing() -> None:
    """1 Hz, load and memory different every time, 60 s: only beats, their reports and ledger rows."""
    pair = pair_of()
    states = {n: n % 4 for n in range(100)}
    pair.offer(pair.robot, STATUS, table(states))
    pair.advance(5 * S)
    pair.forget_history()
    for tick in range(60):
        pair.offer(pair.robot, STATUS, table(states, tick))
        pair.advance(1 * S)
    wire_bytes = sum(len(d) + IP_UDP_BYTES for _, d in pair.robot.sent)
    assert frames(pair.robot) == []
    assert pair.operator.delivered == []
    assert wire_bytes / 60 < 150  # a beat with a ledger row, and the report on the other side's
    assert len(pair.robot.sent) <= 125

    idle = pair_of()
    idle.advance(5 * S)
    idle.forget_history()
    idle.advance(60 * S)
    rows = [f for f in pair.robot.frames(LedgerFrame) if isinstance(f, LedgerFrame)]
    row_bytes = 25 * len(rows)
    assert wire_bytes - sum(len(d) + IP_UDP_BYTES for _, d in idle.robot.sent) <= row_bytes


def test_one_change_is_one_small_message() -> None:
    pair = pair_of()
    states = {n: n % 4 for n in range(100)}
    pair.offer(pair.robot, STATUS, table(states))
    pair.advance(5 * S)
    pair.forget_history()
    states[42] = 9
    for tick in range(10):
        pair.offer(pair.robot, STATUS, table(states, tick))
        pair.advance(1 * S)
    (frame,) = frames(pair.robot)
    assert len(frame.data) < 40
    assert len(pair.operator.delivered) == 1
    assert states_of(pair.operator.payloads[0]) == states_of(table(states))


# The ledger and the wire.


@settings(max_examples=40)
@given(FATES, st.lists(STATES, max_size=20))
def test_every_offer_is_accounted_for(fates: list[str], tables: list[dict[int, int]]) -> None:
    pair = pair_of()
    suffer(pair, fates)
    for states in tables:
        pair.offer(pair.robot, STATUS, table(states))
        assert pair.robot.endpoint.sent_ledgers()[STATUS].queued in (0, 1, 2)
        pair.advance(60 * MS)
    pair.advance(20 * S)
    if tables:
        ledger = pair.robot.endpoint.sent_ledgers()[STATUS]
        assert (ledger.offered, ledger.queued) == (len(tables), 0)


@given(
    st.dictionaries(st.integers(1, (1 << 32) - 1), st.one_of(st.none(), st.binary(min_size=1, max_size=9))),
    st.booleans(),
)
def test_entries_come_back_as_they_were_written(entries: dict[int, bytes | None], whole: bool) -> None:
    data = encode_entries({name: raw or b"" for name, raw in entries.items()}, whole=whole)
    assert decode_entries(data) == (entries, whole)


def test_an_empty_rest_is_there_and_not_gone() -> None:
    assert decode_entries(encode_entries({REST: b""}, whole=False)) == ({REST: b""}, False)


@given(st.binary(max_size=40))
def test_any_bytes_are_entries_or_a_decode_error(data: bytes) -> None:
    with contextlib.suppress(DecodeError):
        decode_entries(data)

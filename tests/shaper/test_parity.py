"""Parity: any k of n shares, no more than the class allows, and none where nothing is lost."""

from __future__ import annotations

import contextlib
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shaper.errors import DecodeError
from shaper.fragments import Reassembler
from shaper.frames import MAX_SHARES, MessageFrame
from shaper.outgoing import Opportunity, Outgoing
from shaper.parity import Protected, decode_shares, encode_shares, protect, share_bytes
from shaper.traffic_class import Keep, TopicRule, TrafficClass
from tests.shaper.pair import MS, Pair, S

S_NS = 1_000_000_000


@given(st.data(), st.binary(min_size=1, max_size=3000), st.integers(1, 40), st.integers(0, 40))
def test_any_k_of_n_shares_give_the_message_back(
    data: st.DataObject, message: bytes, needed: int, repair: int
) -> None:
    needed = min(needed, len(message))
    shares = encode_shares(message, needed, repair)
    arrived = data.draw(st.permutations(range(len(shares))))[:needed]
    if any(not share for share in shares):  # too short to be cut so; the shaper never does
        return
    assert decode_shares({i: shares[i] for i in arrived}, needed, len(message)) == message


def test_the_first_shares_are_the_message_itself() -> None:
    assert b"".join(encode_shares(b"abcdefgh", 3, 2)[:3]) == b"abcdefgh"


def test_the_reassembler_needs_the_shares_in_no_order_and_no_more_than_enough() -> None:
    message = bytes(range(200)) * 20
    shares = encode_shares(message, 10, 4)
    r = Reassembler(1_000_000, 100_000, 10 * S_NS)
    order = [13, 2, 12, 5, 5, 0, 11, 7, 9, 10, 3]
    wholes = [r.add_share((1, 1), i, 10, len(message), shares[i], 0, 0) for i in order]
    assert [w is not None for w in wholes] == [False] * 10 + [True]
    assert wholes[-1] is not None and wholes[-1].data == message
    assert r.add_share((1, 1), 1, 10, len(message), shares[1], 0, 0) is None
    assert (len(r), r.held_bytes) == (0, 0)


@given(
    st.dictionaries(st.integers(0, MAX_SHARES - 1), st.binary(max_size=12), max_size=12),
    st.integers(1, 12),
    st.integers(1, 60),
)
def test_any_shares_decode_or_raise_a_decode_error(shares: dict[int, bytes], needed: int, total: int) -> None:
    with contextlib.suppress(DecodeError):
        assert len(decode_shares(shares, needed, total)) <= max(total, needed * share_bytes(total, needed))


# How much.


def send_all(protected: Protected, loss_ratio: float) -> int:
    """Send what it asks for while nothing is known of any share; how many that are."""
    while not protected.enough(loss_ratio):
        protected.sent += 1
    return protected.sent


@pytest.mark.parametrize("needed", [2, 14, 37, 200])
@pytest.mark.parametrize("loss_ratio", [0.0, 0.001])
def test_no_loss_no_parity(needed: int, loss_ratio: float) -> None:
    assert protect(bytes(1000), needed, loss_ratio, 0.985, 0.5) is None


@given(st.integers(2, 255), st.floats(0, 1), st.floats(0.5, 0.999), st.floats(0, 2))
def test_never_more_than_the_class_allows_or_the_code_can(
    needed: int, loss_ratio: float, target: float, most: float
) -> None:
    protected = protect(bytes(1000), needed, loss_ratio, target, most)
    if protected is not None:
        sent = send_all(protected, loss_ratio)
        assert needed <= sent <= needed * (1 + most)
        assert sent <= MAX_SHARES


@pytest.mark.parametrize(("needed", "loss_ratio"), [(4, 0.02), (18, 0.1), (37, 0.1), (18, 0.2)])
def test_the_fewest_that_reach_the_target_while_nothing_is_known(needed: int, loss_ratio: float) -> None:
    generator = random.Random(1)
    protected = protect(bytes(1000), needed, loss_ratio, 0.975, 1.0)
    assert protected is not None
    sent = send_all(protected, loss_ratio)

    def survives(sent: int) -> float:
        tries = 20_000
        kept = (sum(generator.random() >= loss_ratio for _ in range(sent)) for _ in range(tries))
        return sum(k >= needed for k in kept) / tries

    assert survives(sent) >= 0.975 - 0.005
    assert survives(sent - 1) < 0.975 + 0.005


@given(st.integers(2, 60), st.integers(0, 60), st.integers(0, 10), st.floats(0.01, 0.3))
def test_what_is_known_of_the_shares_decides_how_many_more(
    needed: int, arrived: int, lost: int, loss_ratio: float
) -> None:
    """Each share known to have arrived asks for no more, each known to be lost for no fewer."""
    arrived, lost = min(arrived, needed), min(lost, needed)

    def sent_when_known(arrived: int, lost: int) -> int:
        protected = protect(bytes(1000), needed, loss_ratio, 0.975, 1.0)
        assert protected is not None
        protected.arrived, protected.lost = arrived, lost
        protected.sent = max(needed, arrived + lost)
        return send_all(protected, loss_ratio)

    if arrived + lost <= needed:
        assert sent_when_known(arrived, lost) <= sent_when_known(max(0, arrived - 1), lost)
        assert sent_when_known(arrived, lost) >= sent_when_known(arrived, max(0, lost - 1))


def test_a_message_that_is_known_to_be_there_gets_no_parity() -> None:
    protected = protect(bytes(1000), 10, 0.3, 0.99, 1.0)
    assert protected is not None
    protected.sent = protected.arrived = 10
    assert protected.enough(0.3)


# On the link.


def lossy(pair: Pair, loss_ratio: float) -> None:
    generator = random.Random(5)
    pair.robot.loses = lambda datagram: generator.random() < loss_ratio


def shares_of(pair: Pair) -> list[MessageFrame]:
    return [f for f in pair.robot.frames(MessageFrame) if isinstance(f, MessageFrame) and f.shares_needed]


def test_parity_comes_with_loss_and_goes_with_it() -> None:
    pair = Pair()
    for loss_ratio, expected in ((0.0, False), (0.1, True), (0.0, False)):
        lossy(pair, loss_ratio)
        for _ in range(60):
            pair.offer(pair.robot, "robot/perception/image", bytes(15_000))
            pair.advance(250 * MS)
        pair.forget_history()
        for _ in range(20):
            pair.offer(pair.robot, "robot/perception/image", bytes(15_000))
            pair.advance(250 * MS)
        assert bool(shares_of(pair)) == expected


def test_a_small_message_and_a_class_without_parity_have_none() -> None:
    pair = Pair()
    lossy(pair, 0.2)
    for _ in range(40):
        pair.offer(pair.robot, "robot/perception/small", bytes(500))
        pair.offer(pair.robot, "robot/state/large", bytes(5000))
        pair.advance(100 * MS)
    assert shares_of(pair) == []


@pytest.mark.parametrize("extra_bytes", range(0, 60, 3))
def test_a_share_still_fits_when_its_message_has_grown_old_in_the_queue(extra_bytes: int) -> None:
    """The age takes more bytes then; a share that did not fit would hold its tier until its time ended."""
    pair = Pair()
    lossy(pair, 0.3)
    for _ in range(40):
        pair.offer(pair.robot, "robot/perception/image", bytes(9000))
        pair.advance(200 * MS)
    pair.robot.loses = lambda datagram: False
    pair.advance(2 * S)
    pair.forget_history()
    pair.offer(pair.robot, "robot/perception/image", b"i" * (11_500 + extra_bytes))
    pair.offer(pair.robot, "robot/plan/walk", bytes(400_000))  # 3.4 s of the link
    pair.advance(8 * S)
    assert b"i" * (11_500 + extra_bytes) in pair.operator.payloads


def test_a_message_under_parity_starts_anew_for_a_peer_that_restarted() -> None:
    pair = Pair()
    lossy(pair, 0.3)
    for _ in range(40):
        pair.offer(pair.robot, "robot/perception/image", bytes(9000))
        pair.advance(200 * MS)
    pair.robot.loses = lambda datagram: False
    pair.advance(2 * S)
    pair.offer(pair.robot, "robot/perception/image", b"i" * 30_000)
    pair.advance(120 * MS)
    pair.restart(pair.operator)
    pair.advance(3 * S)
    assert pair.operator.payloads[-1] == b"i" * 30_000


def test_a_share_cut_for_a_fast_link_leaves_alone_when_it_turns_thin_but_not_in_a_train() -> None:
    pictures = TrafficClass("pictures", 1, Keep.LATEST, 10 * S_NS, max_parity_ratio=0.5)
    outgoing = Outgoing((TopicRule("image", pictures),), 10, 100_000)
    outgoing.offer("image", bytes(9000), "", 0, 0)
    fast = Opportunity(1200, 1200, 1_000_000, loss_ratio=0.1, now_ns=0)
    first, train, alone = bytearray(), bytearray(), bytearray()
    assert outgoing.fill(first, fast)[0] and len(first) > 1000
    thin = fast._replace(limit_bytes=300, rate_bps=100_000)
    assert not outgoing.fill(train, thin._replace(timed=True))[0] and not train
    assert outgoing.fill(alone, thin)[0] and len(alone) > 1000

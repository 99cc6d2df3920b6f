"""A carousel's keys come from the two-way link's session; nobody else is heard, and nothing twice."""

from __future__ import annotations

import pytest

from shaper.carousel_seal import CarouselSeal
from shaper.carousel_wire import decode_clear
from shaper.errors import DecodeError
from shaper.open_channel import OpenChannel
from shaper.secure_channel import REKEY_AFTER_NS
from tests.shaper.pair import S
from tests.shaper.secured import OTHER_KEY, SecuredPair

SECRET = bytes(range(32))


def met() -> SecuredPair:
    pair = SecuredPair()
    pair.advance(2 * S)
    return pair


def test_before_the_two_way_link_has_agreed_on_keys_nothing_is_sealed() -> None:
    pair = SecuredPair(operator_keys=(OTHER_KEY,))
    pair.advance(2 * S)
    assert pair.robot.channel.seal_carousel(b"body") is None


def test_what_the_robot_seals_the_operator_opens_once() -> None:
    pair = met()
    sealed = pair.robot.channel.seal_carousel(b"a view")
    assert sealed is not None and b"a view" not in sealed
    assert pair.operator.channel.open_carousel(sealed) == b"a view"
    assert pair.operator.channel.open_carousel(sealed) is None
    assert pair.operator.channel.counters.replayed == 1


def test_it_cannot_be_read_by_who_holds_another_key_nor_sent_back_to_its_sender() -> None:
    pair, other = met(), SecuredPair(robot_keys=(OTHER_KEY,), operator_keys=(OTHER_KEY,))
    other.advance(2 * S)
    sealed = pair.robot.channel.seal_carousel(b"a view")
    assert sealed is not None
    assert pair.robot.channel.open_carousel(sealed) is None
    assert other.operator.channel.open_carousel(sealed) is None


def test_every_flipped_bit_is_found() -> None:
    pair = met()
    sealed = pair.robot.channel.seal_carousel(b"v")
    assert sealed is not None
    for bit in range(8 * len(sealed)):
        broken = bytearray(sealed)
        broken[bit // 8] ^= 1 << bit % 8
        assert pair.operator.channel.open_carousel(bytes(broken)) is None
    assert pair.operator.channel.open_carousel(sealed) == b"v"


def test_no_nonce_is_used_twice_under_a_key() -> None:
    """Numbers count up within a session, and a new session has another key."""
    pair = met()
    numbers: dict[int, list[int]] = {}
    bodies = set()
    for _ in range(3):
        for _ in range(50):
            sealed = pair.robot.channel.seal_carousel(b"the same")
            assert sealed is not None
            session_id, number = decode_clear(sealed)
            numbers.setdefault(session_id, []).append(number)
            bodies.add(sealed[8:])
        pair.advance(REKEY_AFTER_NS + 70 * S)
    assert len(numbers) >= 2
    assert all(each == list(range(len(each))) for each in numbers.values())
    assert len(bodies) == 150


def test_what_left_before_keys_changed_is_still_read_after() -> None:
    pair = met()
    before = pair.robot.channel.seal_carousel(b"before")
    sessions = set(pair.operator.channel.session_ids())
    while set(pair.operator.channel.session_ids()) == sessions:
        pair.advance(S)
    after = pair.robot.channel.seal_carousel(b"after")
    assert before is not None and after is not None
    assert [pair.operator.channel.open_carousel(d) for d in (after, before)] == [b"after", b"before"]


def test_the_carousel_says_nothing_of_whether_the_peer_hears_us() -> None:
    pair = met()
    sealed = pair.robot.channel.seal_carousel(b"body")
    assert sealed is not None
    pair.advance(100_000_000)
    heard_ns = pair.operator.channel.last_heard_ns
    assert pair.operator.channel.open_carousel(sealed) == b"body"
    assert pair.operator.channel.peer_address == pair.robot.address
    assert pair.operator.channel.last_heard_ns == heard_ns


def test_datagrams_may_overtake_each_other() -> None:
    sender, receiver = CarouselSeal(SECRET), CarouselSeal(SECRET)
    sealed = [sender.seal(bytes([i]), 3, "robot") for i in range(100)]
    assert [receiver.open(d, "robot") for d in reversed(sealed)] == [bytes([i]) for i in reversed(range(100))]


def test_the_two_senders_of_a_session_have_different_keys() -> None:
    robot, operator = CarouselSeal(SECRET), CarouselSeal(SECRET)
    assert robot.seal(b"x", 3, "robot") != operator.seal(b"x", 3, "operator")
    with pytest.raises(DecodeError):
        robot.open(operator.seal(b"x", 3, "operator"), "robot")


def test_a_number_that_has_no_nonce_is_refused() -> None:
    seal = CarouselSeal(SECRET)
    seal._number = 1 << 40
    with pytest.raises(ValueError, match=r"at most 2\^40"):
        seal.seal(b"x", 3, "robot")


@pytest.mark.parametrize("data", [b"", b"\x06", b"\x06" + bytes(7), bytes(40), b"\x06" + bytes(39)])
def test_strange_bytes_are_counted(data: bytes) -> None:
    pair = met()
    assert pair.operator.channel.open_carousel(data) is None
    counters = pair.operator.channel.counters
    assert counters.strangers + counters.forged == 1


def test_an_open_channel_passes_bodies_as_they_are() -> None:
    channel = OpenChannel(("127.0.0.1", 1))
    sealed = [channel.seal_carousel(b"body"), channel.seal_carousel(b"body")]
    assert sealed[0] != sealed[1]
    assert [channel.open_carousel(each) for each in sealed if each] == [b"body", b"body"]
    assert channel.open_carousel(b"\x02...........") is None

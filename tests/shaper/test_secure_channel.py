"""Only holders of the key are heard, and whoever holds it is back in business at once."""

from __future__ import annotations

import copy
import random
from functools import cache
from itertools import pairwise
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shaper.frames import HEADER_BYTES
from shaper.handshake import ANSWER_BYTES, INITIATION_BYTES
from shaper.notices import NoticeKind
from shaper.secure_channel import REKEY_AFTER_NS, Address, SecureChannel
from shaper.session import MAX_SEALED, Session
from tests.shaper.pair import HOUR, MS, S
from tests.shaper.secured import ADDRESSES, KEY, OTHER_KEY, Host, SecuredPair

STRANGER = ("203.0.113.9", 4242)


def met(**settings: Any) -> SecuredPair:
    pair = SecuredPair(**settings)
    pair.advance(2 * S)
    return pair


def says(pair: SecuredPair, host: Host, payload: bytes) -> bool:
    """Whether a command of this side's arrives at the other."""
    pair.offer(host, f"{host.side}/command/a", payload)
    pair.advance(1 * S)
    return payload in pair.other(host).payloads


def test_messages_cross_both_ways_under_one_key() -> None:
    pair = met()
    assert says(pair, pair.robot, b"down") and says(pair, pair.operator, b"up")


def test_a_data_datagram_spends_at_most_24_bytes_on_header_and_protection() -> None:
    plain = bytes([1]) + bytes(HEADER_BYTES - 1) + b"frames"
    sealed = met().robot.channel.seal(plain, 1000)
    assert len(sealed) == len(plain) + SecureChannel.overhead_bytes
    assert len(sealed) - len(b"frames") == 19 <= 24


def test_a_handshake_takes_at_most_400_bytes_on_the_wire() -> None:
    pair = SecuredPair()
    pair.loses = lambda data, to: data[0] == 0x03 and to == ADDRESSES["robot"]  # only the robot asks
    pair.advance(400 * MS)
    crossed = [d for host in pair.hosts for _, d, to in host.sent if d[0] & 0x0F in (3, 4, 5)]
    crossed = [d for d in crossed if not (d[0] == 3 and d in [s for _, s, _ in pair.operator.sent])]
    assert sorted(len(d) for d in crossed) == [14, ANSWER_BYTES, INITIATION_BYTES]
    assert sum(len(d) + 28 for d in crossed) <= 400


def test_no_plaintext_crosses() -> None:
    pair = met()
    pair.offer(pair.robot, "robot/command/secret_topic", b"secret payload")
    pair.advance(1 * S)
    assert pair.operator.payloads == [b"secret payload"]
    everything = b"".join(data for host in pair.hosts for _, data, _ in host.sent)
    assert b"secret" not in everything and b"command" not in everything


# What is not the peer's.


@cache
def captured() -> tuple[SecuredPair, list[tuple[bytes, Host]]]:
    """A session with traffic both ways, and every datagram of it with its sender."""
    pair = met()
    for i in range(5):
        pair.offer(pair.robot, "robot/command/a", b"%d" % i)
        pair.offer(pair.operator, "operator/command/a", b"%d" % i)
        pair.advance(200 * MS)
    arrived_ns = pair.now_ns - pair.delay_ns
    return pair, [(d, host) for host in pair.hosts for at_ns, d, _ in host.sent if at_ns <= arrived_ns]


def state_of(host: Host) -> object:
    """All that decides what this side does next, without counters and limits of the uninvited."""
    channel, endpoint = host.channel, host.link.endpoint
    incoming = endpoint._incoming
    assert incoming is not None
    sessions = [(s.own_id, s.made_ns, s.proven, s.used_ns, s.sealed) for s in channel._sessions]
    return copy.deepcopy(
        (
            sessions,
            channel.peer_address,
            channel.last_heard_ns,
            channel.peer,
            endpoint.counters.received_datagrams,
            incoming.received,
            endpoint.packet_number,
            len(host.events),
        )
    )


MANGLE = st.sampled_from(["replayed", "truncated", "flipped", "reflected", "foreign", "extended"])


@given(MANGLE, st.integers(0, 10_000), st.integers(0, 10_000), st.booleans())
def test_what_the_peer_did_not_send_now_changes_no_state(
    how: str, which: int, where: int, moved: bool
) -> None:
    pair, datagrams = captured()
    data, sender = datagrams[which % len(datagrams)]
    target = pair.other(sender)
    if how == "truncated":
        data = data[: where % len(data)]
    elif how == "flipped":
        at = where % (len(data) * 8)
        data = data[: at // 8] + bytes([data[at // 8] ^ 1 << at % 8]) + data[at // 8 + 1 :]
    elif how == "reflected":
        target = sender
    elif how == "foreign":
        data = random.Random(where).randbytes(len(data))
    elif how == "extended":
        data += b"\0" * (1 + where % 20)
    before = state_of(target)
    now_ns = pair.now_ns + target.offset_ns
    target.link.receive(data, STRANGER if moved else pair.other(target).address, now_ns)
    assert state_of(target) == before
    assert len(target.channel._answered) <= 8
    while (answer := target.channel.next_handshake(now_ns)) is not None:
        assert len(answer[0]) <= len(data)  # a repeated initiation may be answered, by no more than it was


def test_a_stranger_costs_bounded_memory_and_gets_no_answer() -> None:
    pair = met()
    noise = random.Random(3)
    sent = len(pair.robot.sent)
    for i in range(3000):
        length = (INITIATION_BYTES, ANSWER_BYTES, 14, 40)[i % 4]
        data = bytes([(3, 4, 5, 2)[i % 4]]) + noise.randbytes(length - 1)
        if i % 8 == 0:
            data = data[:1] + KEY.id + data[5:]
        pair.robot.link.receive(data, STRANGER, pair.now_ns + pair.robot.offset_ns)
    pair.pump(pair.robot)
    assert not [d for _, d, to in pair.robot.sent[sent:] if to == STRANGER]
    channel = pair.robot.channel
    assert (
        len(channel._by_id) <= 3
        and len(channel._initiations._seen_ephemerals) <= 512
        and not channel._answered
    )
    assert channel.counters.failed_handshakes > 0
    assert says(pair, pair.operator, b"still here")


def test_forged_initiations_in_the_peers_name_do_not_delay_a_peer_that_starts_anew() -> None:
    """Somebody knows the key's identifier and the peer's address, and sends as fast as anybody can read."""
    pair = met()
    noise = random.Random(4)

    def flood() -> None:
        for _ in range(500):
            forged = bytes([3]) + KEY.id + noise.randbytes(INITIATION_BYTES - 5)
            pair.robot.link.receive(forged, pair.operator.address, pair.now_ns + pair.robot.offset_ns)

    flood()
    pair.start(pair.operator)
    pair.offer(pair.operator, "operator/command/a", b"anew")
    for _ in range(20):
        flood()
        pair.advance(pair.delay_ns // 5)
    assert b"anew" in pair.robot.payloads
    assert pair.robot.channel.counters.refused_handshakes == 0


def test_a_flood_of_repeated_initiations_does_not_push_out_the_peer() -> None:
    """Somebody has recorded hundreds of true initiations and plays them back from everywhere."""
    pair = met()
    recorded = []
    for i in range(300):
        other = SecuredPair(seed=100 + i)
        recorded += [d for _, d, _ in other.operator.sent if len(d) == INITIATION_BYTES]
    for i, data in enumerate(recorded):
        source = pair.operator.address if i % 2 else STRANGER
        pair.robot.link.receive(data, source, pair.now_ns + pair.robot.offset_ns)
    pair.pump(pair.robot)
    assert len(pair.robot.channel._answered) <= 8
    answers = [d for _, d, to in pair.robot.sent if len(d) == ANSWER_BYTES]
    assert len(answers) <= 25
    assert says(pair, pair.operator, b"still here") and says(pair, pair.robot, b"and here")


def test_a_forged_answer_does_not_spoil_the_handshake() -> None:
    pair = SecuredPair()
    for own_id in list(pair.robot.channel._asked) or [0]:
        pair.pump(pair.robot)
        own_id = next(iter(pair.robot.channel._asked))
        forged = bytes([4]) + own_id.to_bytes(2, "little") + bytes(ANSWER_BYTES - 3)
        pair.robot.link.receive(forged, STRANGER, pair.now_ns + pair.robot.offset_ns)
    pair.advance(200 * MS)
    assert pair.robot.channel.ready


def test_a_key_seals_no_packet_number_twice() -> None:
    pair = met()
    session: Session = pair.robot.channel._current
    plain = bytes([1]) + bytes(20)
    session.seal(plain, 5000)
    with pytest.raises(ValueError, match="only once"):
        session.seal(plain, 5000)


def test_a_key_that_a_peers_questions_wear_out_says_no_more_and_is_replaced() -> None:
    pair = met()
    robot, operator = pair.robot.channel, pair.operator.channel
    worn: Session = robot._current
    worn._control_number = MAX_SEALED - 2
    for _ in range(6):
        asked = operator.seal_control(b"\x05" + bytes(8))
        pair.receive(pair.robot, asked, pair.operator.address)
    assert worn.worn and worn._control_number == MAX_SEALED
    pair.offer(pair.robot, "robot/command/a", b"go on")
    pair.advance(6 * S)  # the wear is looked at every three seconds
    assert robot._current is not worn and robot.ready
    assert pair.operator.payloads[-1] == b"go on"


# Keys.


def test_another_key_under_the_same_identifier_is_named() -> None:
    wrong = type(KEY)(KEY.id, OTHER_KEY.secret)
    pair = SecuredPair(operator_keys=(wrong,))
    pair.advance(20 * S)
    assert not pair.robot.channel.ready
    (text, *_) = pair.robot.notices(NoticeKind.WRONG_KEY)
    assert KEY.name in text and "compare the key files" in text
    (text, *_) = pair.operator.notices(NoticeKind.NO_ANSWER)
    assert "10.0.0.1:9001" in text and "link.keys" in text


def test_another_key_identifier_is_named_on_both_sides() -> None:
    pair = SecuredPair(operator_keys=(OTHER_KEY,))
    pair.advance(20 * S)
    (text, *_) = pair.robot.notices(NoticeKind.UNKNOWN_KEY)
    assert OTHER_KEY.name in text and KEY.name in text and "copy the same key file" in text
    assert pair.operator.notices(NoticeKind.UNKNOWN_KEY)


def test_two_robots_do_not_meet() -> None:
    pair = SecuredPair(operator_side="robot")
    pair.advance(10 * S)
    assert not pair.robot.channel.ready
    assert any("link.side" in text for text in pair.robot.notices(NoticeKind.WRONG_KEY))


def test_both_sides_roll_their_keys_one_after_the_other_without_an_outage() -> None:
    pair = met()
    steps = (
        (pair.robot, (KEY, OTHER_KEY)),
        (pair.operator, (OTHER_KEY, KEY)),
        (pair.robot, (OTHER_KEY,)),
        (pair.operator, (OTHER_KEY,)),
    )
    for host, keys in steps:
        host.keys = keys
        pair.start(host)
        pair.advance(4 * pair.delay_ns)
        assert says(pair, pair.robot, b"down") and says(pair, pair.operator, b"up")
    assert pair.robot.channel._current.key_name == OTHER_KEY.name


def test_keys_are_replaced_every_ten_minutes_and_nothing_is_lost_meanwhile() -> None:
    pair = met()
    first = pair.robot.channel._current.own_id
    for i in range(130):
        pair.offer(pair.robot, "robot/state/a", b"%d" % i)
        pair.advance(10 * S)
    assert pair.now_ns > 2 * REKEY_AFTER_NS
    assert pair.operator.payloads == [b"%d" % i for i in range(130)]
    assert pair.robot.channel._current.own_id != first
    assert pair.robot.channel.counters.handshakes <= 8
    assert len(pair.robot.channel._by_id) <= 3


# Clocks.


@pytest.mark.parametrize(("hours", "how"), [(1, "ahead of"), (-1, "behind")])
def test_a_clock_an_hour_off_is_told_and_changes_no_age(hours: int, how: str) -> None:
    pair = met(operator_unix_offset_ns=hours * HOUR)
    (text,) = pair.robot.notices(NoticeKind.CLOCK_DIFFERS)
    assert f"60 min {how} ours" in text and "chrony" in text
    pair.offer(pair.operator, "operator/command/a")
    pair.advance(1 * S)
    (delivered,) = [e for e in pair.robot.events if hasattr(e, "age_ns")]
    assert delivered.age_ns == pytest.approx(50 * MS, abs=MS)


def test_clocks_that_agree_are_not_spoken_of() -> None:
    pair = met()
    assert not any(host.notices(NoticeKind.CLOCK_DIFFERS) for host in pair.hosts)


# Restarts, roaming, blackouts.


@pytest.mark.parametrize("victim", ["robot", "operator"])
@pytest.mark.parametrize("delay_ms", [5, 50, 500])
def test_both_directions_carry_again_two_round_trips_after_a_restart(victim: str, delay_ms: int) -> None:
    pair = SecuredPair(delay_ns=delay_ms * MS)
    pair.advance(10 * S)
    host = pair.robot if victim == "robot" else pair.operator
    other = pair.other(host)
    before = len(other.payloads)
    pair.start(host)
    pair.offer(host, f"{host.side}/command/a", b"from the one that died")
    pair.offer(other, f"{other.side}/command/a", b"to it")
    pair.advance(4 * pair.delay_ns)
    assert b"to it" in host.payloads
    assert b"from the one that died" in other.payloads[before:]


def test_the_peer_may_move_and_is_followed() -> None:
    pair = met()
    pair.operator.address = ("198.51.100.7", 50_000)
    assert says(pair, pair.operator, b"from elsewhere")
    assert pair.robot.channel.peer_address == ("198.51.100.7", 50_000)
    assert says(pair, pair.robot, b"to elsewhere")
    (text,) = pair.robot.notices(NoticeKind.PEER_MOVED)
    assert "198.51.100.7:50000" in text


def test_a_repeated_datagram_from_elsewhere_moves_nobody() -> None:
    pair = met()
    pair.offer(pair.operator, "operator/command/a")
    data = pair.operator.sent[-1][1]
    pair.advance(1 * S)
    pair.receive(pair.robot, data, STRANGER)
    assert pair.robot.channel.peer_address == ADDRESSES["operator"]


def test_a_true_datagram_from_a_strangers_address_draws_no_more_than_a_few_copies_there() -> None:
    """Somebody is faster than the network, and passes on what he overhears from an address of his own."""
    pair = met()
    strangers_bytes = 0
    for i in range(20):
        pair.offer(pair.operator, "operator/command/a", b"%d" % i)
        data = pair.operator.sent[-1][1]
        strangers_bytes += len(data)
        pair.receive(pair.robot, data, STRANGER)
        pair.offer(pair.robot, "robot/command/a", b"answer %d" % i)
        pair.advance(200 * MS)
    assert pair.robot.channel.peer_address == ADDRESSES["operator"]
    assert not pair.robot.notices(NoticeKind.PEER_MOVED)
    drawn_bytes = sum(len(d) for _, d, to in pair.robot.sent if to == STRANGER)
    assert 0 < drawn_bytes <= 3 * strangers_bytes
    assert pair.operator.payloads == [b"answer %d" % i for i in range(20)]


def test_a_stranger_who_cannot_answer_a_challenge_is_never_taken_for_the_peer() -> None:
    """He passes the challenge on: the peer answers it from where it is, and stays there."""
    pair = met()
    pair.offer(pair.operator, "operator/command/a")
    pair.receive(pair.robot, pair.operator.sent[-1][1], STRANGER)
    pair.underway.clear()
    challenges = [d for _, d, to in pair.robot.sent if to == STRANGER]
    assert challenges
    for challenge in challenges:
        pair.receive(pair.operator, challenge, ADDRESSES["robot"])
    pair.advance(5 * S)
    assert pair.robot.channel.peer_address == ADDRESSES["operator"]


@pytest.mark.parametrize("delay_ms", [5, 50, 500])
def test_a_peer_that_moves_hears_and_is_heard_again_within_two_round_trips(delay_ms: int) -> None:
    pair = SecuredPair(delay_ns=delay_ms * MS)
    pair.advance(10 * S)
    pair.operator.address = ("198.51.100.7", 50_000)
    pair.offer(pair.operator, "operator/command/a", b"from elsewhere")
    pair.advance(pair.delay_ns)
    pair.offer(pair.robot, "robot/command/a", b"to elsewhere")
    pair.advance(pair.delay_ns)
    assert b"from elsewhere" in pair.robot.payloads
    assert b"to elsewhere" in pair.operator.payloads, "a copy goes where the peer seems to be"
    pair.advance(2 * pair.delay_ns)
    assert pair.robot.channel.peer_address == ("198.51.100.7", 50_000)


def test_a_side_that_moves_and_dies_is_found_again_at_either_address() -> None:
    pair = met()
    pair.operator.address = ("198.51.100.7", 50_000)
    pair.advance(2 * S)
    pair.robot.address = ("198.51.100.8", 50_001)
    pair.advance(2 * S)
    pair.operator.address = ADDRESSES["operator"]
    pair.start(pair.operator)
    pair.advance(8 * S)
    assert says(pair, pair.robot, b"down") and says(pair, pair.operator, b"up")


@pytest.mark.parametrize("blackout_s", [2, 30, 700])
def test_the_link_goes_on_after_a_blackout(blackout_s: int) -> None:
    pair = met()
    pair.loses = lambda data, to: True
    pair.advance(blackout_s * S)
    sent = [d for t, d, _ in pair.robot.sent if t > 2 * S]
    assert sum(len(d) == INITIATION_BYTES for d in sent) <= blackout_s // 2 + 1
    pair.loses = lambda data, to: False
    pair.advance(3 * S)
    assert says(pair, pair.robot, b"down") and says(pair, pair.operator, b"up")


def test_a_long_silence_is_asked_into_ever_more_seldom_but_every_ten_seconds() -> None:
    """A link that stands still keeps them all, and serves them before anything new."""
    pair = met()
    pair.loses = lambda data, to: True
    pair.advance(120 * S)
    asked = [t for t, d, _ in pair.robot.sent if t > 3 * S and len(d) == INITIATION_BYTES]
    gaps = [(b - a) / S for a, b in pairwise(asked)]
    assert gaps[0] == pytest.approx(2, abs=0.1) and gaps == sorted(gaps) and max(gaps) < 10.1
    assert sum(t < 32 * S for t in asked) <= 8


def held_initiations(pair: SecuredPair) -> list[bytes]:
    """The robot's of a long darkness: what a link that held them brings at once, when it is back."""
    pair.loses = lambda data, to: True
    pair.advance(40 * S)
    pair.loses = lambda data, to: False
    return [d for t, d, _ in pair.robot.sent if t > 3 * S and len(d) == INITIATION_BYTES]


def answers_to(pair: SecuredPair, data: bytes, source: Address) -> int:
    """How many the operator sends."""
    before = len(pair.operator.sent)
    pair.operator.link.receive(data, source, pair.now_ns + pair.operator.offset_ns)
    pair.pump(pair.operator)
    return sum(len(d) == ANSWER_BYTES and to == source for _, d, to in pair.operator.sent[before:])


def test_initiations_that_a_link_has_held_are_answered_once() -> None:
    pair = met()
    held = held_initiations(pair)
    assert len(held) > 5
    assert [answers_to(pair, data, pair.robot.address) for data in held] == [1] + [0] * (len(held) - 1)
    assert pair.operator.channel.counters.refused_handshakes == len(held) - 1
    assert says(pair, pair.robot, b"down") and says(pair, pair.operator, b"up")


def test_one_from_elsewhere_or_a_second_later_is_answered_too() -> None:
    pair = met()
    here, elsewhere, later = held_initiations(pair)[:3]
    assert answers_to(pair, here, pair.robot.address) == 1
    assert answers_to(pair, elsewhere, STRANGER) == 1
    pair.loses = lambda data, to: True
    pair.advance(1 * S)
    assert answers_to(pair, later, pair.robot.address) == 1


def test_a_peer_that_has_started_anew_is_answered_at_once_though_its_former_life_just_was() -> None:
    pair = met()
    assert answers_to(pair, held_initiations(pair)[0], pair.robot.address) == 1
    before = len(pair.operator.sent)
    pair.start(pair.robot)
    pair.advance(2 * pair.delay_ns)
    assert any(len(d) == ANSWER_BYTES for _, d, _ in pair.operator.sent[before:])
    assert says(pair, pair.robot, b"down") and says(pair, pair.operator, b"up")


def test_a_lost_answer_or_proof_delays_the_meeting_by_one_retry() -> None:
    for kind in (3, 4, 5):
        pair = SecuredPair()
        once: list[int] = []

        def loses(data: bytes, to: object, kind: int = kind, once: list[int] = once) -> bool:
            if data[0] & 0x0F == kind and len(once) < 2:
                once.append(1)
                return True
            return False

        pair.loses = loses
        pair.advance(1 * S)
        assert says(pair, pair.robot, b"down") and says(pair, pair.operator, b"up"), kind

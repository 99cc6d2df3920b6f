"""Stories of two endpoints on a link that loses nothing unless told to."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shaper.frames import IP_UDP_BYTES, KnownFrame, MessageFrame, ReportFrame
from shaper.incoming import Limits
from shaper.pacer import Pacer
from shaper.reliable import ReliableQueue
from shaper.traffic_class import DEFAULT_CLASSES, Compression, TopicRule
from tests.shaper.pair import FAST, HOUR, MS, THIN, UNIX_NS, Pair, S, Side

MESSAGE = b"0123456789"


def message_frames(side: Side) -> list[MessageFrame]:
    return [f for f in side.frames(MessageFrame) if isinstance(f, MessageFrame)]


def saturate(pair: Pair, payload_bytes: int = 50_000) -> None:
    """Keep the robot's link busy with bulk for a while."""
    pair.offer(pair.robot, "robot/bulk/log", bytes(payload_bytes))


# Carrying messages.


def test_a_message_crosses_with_its_key_its_encoding_and_its_bytes() -> None:
    pair = Pair()
    pair.offer(pair.robot, "robot/state/pose", MESSAGE, encoding="application/cdr")
    pair.advance(100 * MS)
    (event,) = pair.operator.delivered
    assert (event.key, event.encoding, event.payload) == ("robot/state/pose", "application/cdr", MESSAGE)


def test_an_empty_message_is_a_message() -> None:
    pair = Pair()
    pair.offer(pair.robot, "robot/state/pose", b"")
    pair.advance(100 * MS)
    assert pair.operator.payloads == [b""]


def test_small_messages_share_a_datagram() -> None:
    pair = Pair()
    for i in range(5):
        pair.offer(pair.robot, f"robot/state/{i}", MESSAGE, pumped=False)
    pair.pump(pair.robot)
    assert len(pair.robot.sent) == 1
    pair.advance(100 * MS)
    assert pair.operator.payloads == [MESSAGE] * 5


@pytest.mark.parametrize("payload_bytes", [1_100, 1_190, 1_200, 5_000, 60_000])
def test_a_large_message_is_parted_and_put_together(payload_bytes: int) -> None:
    pair = Pair()
    payload = bytes(i * i & 0xFF for i in range(payload_bytes))
    pair.offer(pair.robot, "robot/perception/image", payload)
    pair.advance(2 * S)
    assert pair.operator.payloads == [payload]
    assert all(len(datagram) <= 1200 for _, datagram in pair.robot.sent)


def test_a_message_that_fits_a_datagram_of_its_own_is_not_split() -> None:
    pair = Pair()
    for name in ("a", "b"):
        pair.offer(pair.robot, f"robot/command/{name}", bytes(700), pumped=False)
    pair.pump(pair.robot)
    pair.advance(1 * S)
    assert [len(frame.data) for frame in message_frames(pair.robot)] == [700, 700]


def test_no_part_but_the_last_is_tiny() -> None:
    pair = Pair()
    for filler_bytes in range(1050, 1150, 7):
        pair.forget_history()
        pair.offer(pair.robot, "robot/command/a", bytes(filler_bytes), pumped=False)
        pair.offer(pair.robot, "robot/bulk/b", bytes(3000), pumped=False)
        pair.pump(pair.robot)
        pair.advance(1 * S)
        parts = [frame for frame in message_frames(pair.robot) if not frame.is_whole]
        assert all(len(frame.data) >= 48 for frame in parts[:-1])
        assert [len(payload) for payload in pair.operator.payloads] == [filler_bytes, 3000]


def test_a_compressed_topic_arrives_as_it_was_offered() -> None:
    rule = TopicRule("robot/state", DEFAULT_CLASSES["state"], compression=Compression.ZSTD)
    pair = Pair(rules=(rule,))
    pair.offer(pair.robot, "robot/state", b"joint" * 1000)
    pair.advance(100 * MS)
    assert pair.operator.payloads == [b"joint" * 1000]
    assert sum(len(d) for _, d in pair.robot.sent) < 300


def test_on_a_thin_link_a_datagram_takes_no_more_than_50_ms() -> None:
    pair = Pair(bands=(THIN,))
    pair.offer(pair.robot, "robot/perception/image", bytes(5000))
    pair.advance(3 * S)
    assert pair.operator.payloads == [bytes(5000)]
    assert max(len(d) + IP_UDP_BYTES for _, d in pair.robot.sent) * 8 <= THIN.rate_bps * 0.050


# Order.


def test_a_higher_tier_overtakes_between_the_parts_of_a_large_message() -> None:
    pair = Pair()
    saturate(pair, 20_000)
    pair.advance(40 * MS)
    pair.offer(pair.robot, "robot/heartbeat", MESSAGE)
    pair.advance(1 * S)
    assert pair.operator.payloads == [MESSAGE, bytes(20_000)]
    assert pair.operator.delivered[0].one_way_delay_ns < 61 * MS  # at most one full datagram before it
    assert pair.operator.delivered[0].age_ns < 75 * MS


def test_the_newest_sample_leaves_when_its_turn_comes() -> None:
    pair = Pair()
    pair.offer(pair.robot, "robot/command/plan", bytes(20_000))
    for i in range(10):
        pair.offer(pair.robot, "robot/state/pose", b"%d" % i)
        pair.advance(10 * MS)
    pair.advance(1 * S)
    assert pair.operator.payloads == [bytes(20_000), b"9"]
    ledger = pair.robot.endpoint.sent_ledgers()["robot/state/pose"]
    assert (ledger.offered, ledger.superseded, ledger.sent) == (10, 9, 1)


def test_a_fifo_arrives_in_order() -> None:
    pair = Pair()
    saturate(pair)
    for i in range(20):
        pair.offer(pair.robot, "robot/command/step", b"%d" % i, pumped=False)
    pair.advance(1 * S)
    commands = [e.payload for e in pair.operator.delivered if "command" in e.key]
    assert commands == [b"%d" % i for i in range(20)]


# Time to live.


def test_an_expired_message_is_not_sent_and_counted() -> None:
    pair = Pair()
    pair.offer(pair.robot, "robot/state/pose", MESSAGE, age_ns=2 * S + 1)
    pair.advance(1 * S)
    assert not message_frames(pair.robot)
    assert pair.robot.endpoint.sent_ledgers()["robot/state/pose"].expired == 1


def test_a_message_that_expires_in_the_queue_is_not_sent() -> None:
    pair = Pair()
    pair.offer(pair.robot, "robot/command/plan", bytes(200_000))
    pair.offer(pair.robot, "robot/state/pose", MESSAGE, age_ns=1 * S)
    pair.advance(5 * S)
    assert pair.operator.payloads == [bytes(200_000)]
    assert pair.robot.endpoint.sent_ledgers()["robot/state/pose"].expired == 1


def test_a_message_that_cannot_be_in_time_is_not_begun() -> None:
    pair = Pair()
    pair.offer(pair.robot, "robot/state/map", bytes(300_000))  # 2.5 s of the link, worth 2 s
    assert not message_frames(pair.robot)
    assert pair.robot.endpoint.sent_ledgers()["robot/state/map"].expired == 1


def test_a_message_that_can_no_longer_be_in_time_is_given_up_midway() -> None:
    pair = Pair()
    pair.offer(pair.robot, "robot/state/map", bytes(150_000))
    pair.advance(500 * MS)
    pair.offer(pair.robot, "robot/command/plan", bytes(150_000))
    pair.offer(pair.robot, "robot/state/next", MESSAGE)
    pair.advance(2 * S)
    ledger = pair.robot.endpoint.sent_ledgers()["robot/state/map"]
    assert (ledger.sent, ledger.expired, ledger.queued) == (0, 1, 0)
    assert 40_000 < ledger.sent_bytes < 80_000
    assert pair.operator.payloads == [bytes(150_000), MESSAGE]


# Names.


def test_a_name_is_sent_until_it_is_confirmed_and_no_longer() -> None:
    pair = Pair()
    for _ in range(20):
        pair.offer(pair.robot, "robot/state/pose", MESSAGE)
        pair.advance(50 * MS)
    named = [frame.name is not None for frame in message_frames(pair.robot)]
    assert named[:2] == [True, True]
    assert named == sorted(named, reverse=True)
    assert sum(named) <= 5  # 100 ms of round trip, 50 ms until a report is due
    assert pair.operator.payloads == [MESSAGE] * 20


def test_names_go_on_while_confirmations_are_lost() -> None:
    pair = Pair()
    pair.operator.loses = lambda datagram: True
    for _ in range(10):
        pair.offer(pair.robot, "robot/state/pose", MESSAGE)
        pair.advance(50 * MS)
    assert all(frame.name for frame in message_frames(pair.robot))
    pair.operator.loses = lambda datagram: False
    for _ in range(10):
        pair.offer(pair.robot, "robot/state/pose", MESSAGE)
        pair.advance(50 * MS)
    assert message_frames(pair.robot)[-1].name is None
    assert pair.operator.payloads == [MESSAGE] * 20


def test_the_same_key_in_another_encoding_has_a_name_of_its_own() -> None:
    pair = Pair()
    for encoding in ("text/plain", "application/json", "text/plain"):
        pair.offer(pair.robot, "robot/command/say", MESSAGE, encoding=encoding)
        pair.advance(300 * MS)
    assert [e.encoding for e in pair.operator.delivered] == ["text/plain", "application/json", "text/plain"]


# Restarts.


@pytest.mark.parametrize("who", ["robot", "operator"])
def test_either_side_restarts_and_traffic_goes_on_within_two_round_trips(who: str) -> None:
    pair = Pair()
    for _ in range(10):
        pair.offer(pair.robot, "robot/state/pose", MESSAGE)
        pair.offer(pair.operator, "operator/state/hand", MESSAGE)
        pair.advance(50 * MS)
    restarted = getattr(pair, who)
    pair.restart(restarted)
    pair.forget_history()
    for _ in range(4):  # two round trips of 100 ms
        pair.offer(pair.robot, "robot/state/pose", b"after")
        pair.offer(pair.operator, "operator/state/hand", b"after")
        pair.advance(50 * MS)
    pair.advance(50 * MS)
    assert b"after" in pair.operator.payloads
    assert b"after" in pair.robot.payloads
    (start,) = pair.other(restarted).peer_starts
    assert start.again


def test_what_was_in_flight_to_a_former_peer_holds_nothing_back_from_the_new_one() -> None:
    pair = Pair()
    pair.robot.loses = lambda datagram: True
    saturate(pair, 400_000)
    pair.advance(5 * S)
    assert pair.robot.endpoint.holding
    pair.robot.loses = lambda datagram: False
    pair.restart(pair.operator)
    pair.advance(pair.operator.delay_ns)
    assert not pair.robot.endpoint.holding


def test_both_sides_restart_at_once() -> None:
    pair = Pair()
    pair.restart(pair.robot)
    pair.restart(pair.operator)
    pair.advance(1 * S)
    pair.offer(pair.robot, "robot/bulk/a", bytes(3000))
    pair.offer(pair.operator, "operator/command/a", MESSAGE)
    pair.advance(200 * MS)
    assert (pair.operator.payloads, pair.robot.payloads) == ([bytes(3000)], [MESSAGE])


def test_the_sides_find_each_other_whoever_comes_first_and_however_late() -> None:
    pair = Pair(met=False)
    pair.operator.loses = lambda datagram: True
    pair.robot.loses = lambda datagram: True
    pair.advance(10 * S)
    assert len(pair.robot.sent) == 21  # searching twice a second
    pair.operator.loses = pair.robot.loses = lambda datagram: False
    pair.offer(pair.robot, "robot/command/a", MESSAGE)
    pair.advance(1 * S)
    assert pair.operator.payloads == [MESSAGE]
    assert [s.again for s in pair.robot.peer_starts] == [False]


def test_datagrams_of_a_former_life_are_dropped() -> None:
    pair = Pair()
    pair.offer(pair.robot, "robot/command/old", b"old")
    late = list(pair.robot.underway)
    pair.drop(pair.robot)
    pair.restart(pair.robot)
    pair.advance(1 * S)
    pair.robot.underway += late
    pair.advance(1 * S)
    assert b"old" not in pair.operator.payloads
    assert pair.operator.endpoint.counters.stale_epoch == len(late)
    assert len(pair.operator.peer_starts) == 1


def test_reports_on_a_former_life_are_ignored() -> None:
    pair = Pair()
    for _ in range(40):
        pair.offer(pair.robot, "robot/command/a", MESSAGE)
        pair.advance(10 * MS)
    pair.restart(pair.robot)  # reports on packet numbers that it has never sent are underway
    pair.advance(1 * S)
    assert pair.robot.endpoint.counters.malformed == 0


def test_a_peer_just_met_is_reported_on_at_once() -> None:
    pair = Pair(bands=(THIN, FAST), delay_ns=50 * MS, met=False)
    pair.advance(160 * MS)  # there, back, and there again; a thin link's reports wait for 200 ms
    assert pair.robot.endpoint.link_state().band == "fast"
    assert pair.operator.endpoint.link_state().band == "fast"


# Loss, duplicates, reordering.


def test_duplicates_deliver_once() -> None:
    pair = Pair()
    pair.offer(pair.robot, "robot/command/a", MESSAGE)
    pair.offer(pair.robot, "robot/bulk/b", bytes(3000))
    pair.advance(40 * MS)
    pair.robot.underway += pair.robot.underway
    pair.advance(1 * S)
    assert pair.operator.payloads == [MESSAGE, bytes(3000)]
    assert pair.operator.endpoint.counters.duplicate >= 3


def test_a_reordered_latest_sample_is_stale_and_a_reordered_command_waits_for_its_turn() -> None:
    pair = Pair()
    for payload, gap_ns in ((b"0", 100 * MS), (b"1", 20 * MS), (b"2", 20 * MS)):
        pair.offer(pair.robot, "robot/state/pose", payload)
        pair.offer(pair.robot, "robot/command/a", payload)
        pair.advance(gap_ns)
    pair.robot.underway.reverse()
    pair.transfer(pair.robot)
    latest = [e.payload for e in pair.operator.delivered if "state" in e.key]
    commands = [e.payload for e in pair.operator.delivered if "command" in e.key]
    assert latest == [b"0", b"2"]
    assert commands == [b"0", b"1", b"2"]  # the class is reliable now: in order
    ledgers = pair.operator.endpoint.received_ledgers
    assert (ledgers["robot/state/pose"].stale, ledgers["robot/state/pose"].lost) == (1, 0)
    assert (ledgers["robot/command/a"].stale, ledgers["robot/command/a"].lost) == (0, 0)


def test_a_lost_datagram_shows_in_the_counters_of_loss() -> None:
    pair = Pair()
    for i in range(20):
        pair.offer(pair.robot, "robot/state/a", b"%d" % i)
        if i in (5, 6, 11):
            assert pair.drop(pair.robot) == 1
        pair.advance(100 * MS)
    assert len(pair.operator.delivered) == 17
    assert pair.operator.endpoint.received_ledgers["robot/state/a"].lost == 3
    pair.advance(1 * S)
    assert pair.robot.endpoint.link_state().loss_ratio > 0


def test_a_lost_part_loses_the_message_and_no_other() -> None:
    pair = Pair()
    pair.offer(pair.robot, "robot/bulk/a", b"a" * 5000)
    pair.drop(pair.robot)
    pair.advance(200 * MS)
    pair.offer(pair.robot, "robot/bulk/a", b"b" * 5000)
    pair.advance(1 * S)
    assert pair.operator.payloads == [b"b" * 5000]


# What is not carried.


def test_a_key_without_a_rule_stays_here() -> None:
    pair = Pair()
    assert not pair.offer(pair.robot, "robot/secret", MESSAGE)
    pair.advance(1 * S)
    assert not message_frames(pair.robot)
    assert pair.robot.endpoint.counters_dict()["unmatched"] == 1


def test_a_key_that_this_side_does_not_accept_is_not_delivered() -> None:
    pair = Pair(accept=("robot/state/**",))
    pair.offer(pair.robot, "robot/state/pose", MESSAGE)
    pair.offer(pair.robot, "robot/command/jump", MESSAGE)
    pair.advance(1 * S)
    assert [e.key for e in pair.operator.delivered] == ["robot/state/pose"]
    assert pair.operator.endpoint.counters_dict()["refused_messages"] == 1
    assert list(pair.operator.endpoint.received_ledgers) == ["robot/state/pose"]


def test_too_large_a_message_is_refused_and_accounted_for() -> None:
    pair = Pair(limits=Limits(max_message_bytes=1000))
    assert not pair.offer(pair.robot, "robot/bulk/a", bytes(1001))
    assert pair.offer(pair.robot, "robot/bulk/a", bytes(1000))
    ledger = pair.robot.endpoint.sent_ledgers()["robot/bulk/a"]
    assert (ledger.offered, ledger.overflow, pair.robot.endpoint.counters_dict()["refused_offers"]) == (
        2,
        1,
        1,
    )


def test_topics_beyond_the_limit_are_refused_and_the_others_go_on() -> None:
    pair = Pair(limits=Limits(max_topics=3))
    for _ in range(2):
        for i in range(5):
            pair.offer(pair.robot, f"robot/command/{i}", MESSAGE)
        pair.advance(1 * S)
    assert [e.key[-1] for e in pair.operator.delivered] == ["0", "1", "2"] * 2
    assert pair.robot.endpoint.counters_dict()["refused_offers"] == 4
    assert pair.robot.endpoint.counters_dict()["unmatched"] == 0


# Holding, blackouts, pacing.


def test_before_the_peer_is_heard_only_always_send_leaves() -> None:
    pair = Pair(met=False)
    pair.robot.loses = pair.operator.loses = lambda datagram: True
    pair.advance(0)
    for name in ("emergency", "heartbeat", "command/a", "bulk/a"):
        pair.offer(pair.robot, f"robot/{name}", name.encode())
    assert {frame.data for frame in message_frames(pair.robot)} == {b"emergency", b"heartbeat"}


def test_a_silent_link_stops_bulk_but_not_the_heartbeat() -> None:
    pair = Pair()
    pair.robot.loses = lambda datagram: True
    for _ in range(100):
        saturate(pair)
        pair.offer(pair.robot, "robot/heartbeat", b"beat")
        pair.advance(100 * MS)
    state = pair.robot.endpoint.link_state()
    assert state.holding
    bulk_bytes = sum(len(f.data) for f in message_frames(pair.robot) if f.data != b"beat")
    assert bulk_bytes < state.in_flight_limit_bytes + 1500
    assert sum(f.data == b"beat" for f in message_frames(pair.robot)) >= 99


def test_traffic_goes_on_by_itself_after_everything_in_flight_was_lost() -> None:
    pair = Pair()
    pair.robot.loses = lambda datagram: True
    saturate(pair, 400_000)
    pair.advance(30 * S)
    assert pair.robot.endpoint.holding
    pair.robot.loses = lambda datagram: False
    pair.advance(1200 * MS)  # at most one beat and a round trip later
    assert not pair.robot.endpoint.holding
    pair.offer(pair.robot, "robot/command/a", MESSAGE)
    pair.advance(100 * MS)
    assert MESSAGE in pair.operator.payloads


def test_an_emergency_waits_for_no_pacing() -> None:
    pair = Pair(bands=(THIN,))
    saturate(pair)
    pair.advance(100 * MS)
    before = len(pair.robot.sent)
    pair.offer(pair.robot, "robot/emergency", b"stop")
    assert len(pair.robot.sent) == before + 1
    pair.advance(THIN.one_way_delay_ns)
    assert b"stop" in pair.operator.payloads


def test_all_but_emergencies_wait_for_the_pacer_beats_and_reports_too() -> None:
    pair = Pair(bands=(THIN,))
    pacer = Pacer(95_000, 118, pair.now_ns)
    for i in range(200):
        pair.offer(pair.robot, "robot/bulk/log", bytes(3000))
        pair.offer(pair.robot, "robot/heartbeat", b"beat")
        pair.offer(pair.operator, "operator/command/a", b"%d" % i)
        pair.advance(47 * MS)
    for t, datagram in pair.robot.sent:
        assert pacer.may_send(t)
        pacer.on_sent(len(datagram) + IP_UDP_BYTES, t)


def test_what_an_emergency_took_is_paid_back() -> None:
    pair = Pair()
    start_ns = pair.now_ns
    for _ in range(50):
        pair.offer(pair.robot, "robot/emergency", bytes(1000))
    saturate(pair, 400_000)
    pair.advance(3 * S)
    wire_bits = sum(len(d) + IP_UDP_BYTES for _, d in pair.robot.sent) * 8
    assert wire_bits * S <= 950_000 * (pair.now_ns - start_ns) + (1187 + 1228) * 8 * S


@settings(max_examples=25)
@given(
    offers=st.lists(
        st.tuples(
            st.sampled_from(["heartbeat", "command/a", "state/a", "perception/a", "bulk/a", "bulk/b"]),
            st.integers(0, 8000),
            st.integers(0, 60 * MS),
        ),
        min_size=5,
        max_size=40,
    )
)
def test_no_interval_carries_more_than_the_paced_rate_and_every_message_is_accounted_for(
    offers: list[tuple[str, int, int]],
) -> None:
    pair = Pair()
    for name, payload_bytes, gap_ns in offers:
        pair.offer(pair.robot, f"robot/{name}", bytes(payload_bytes))
        pair.advance(gap_ns)
        for queue in pair.robot.endpoint._outgoing.queues():
            # A reliable message that departs is outstanding; it waits until its receipt has come.
            under_way = set(queue.outstanding) if isinstance(queue, ReliableQueue) else set[int]()
            if queue.departing is not None:
                under_way.add(queue.departing.number)
            assert queue.ledger.queued == len(queue.waiting) + len(under_way)
    pair.advance(10 * S)
    departures = [(t, (len(d) + IP_UDP_BYTES) * 8) for t, d in pair.robot.sent]
    for first, (start_ns, _) in enumerate(departures):
        bits = 0
        for t, datagram_bits in departures[first:]:
            bits += datagram_bits
            assert bits * S <= 950_000 * (t - start_ns) + (1187 + 1228) * 8 * S
    delivered = sum(ledger.delivered for ledger in pair.operator.endpoint.received_ledgers.values())
    assert delivered == sum(ledger.sent for ledger in pair.robot.endpoint.sent_ledgers().values())
    assert all(ledger.queued == 0 for ledger in pair.robot.endpoint.sent_ledgers().values())


@settings(max_examples=25)
@given(data=st.data())
def test_no_message_leaves_while_one_of_a_higher_tier_waits(data: st.DataObject) -> None:
    pair = Pair()
    tiers = {"heartbeat": 1, "command/a": 2, "state/a": 3, "perception/a": 4, "bulk/a": 5}
    for name in data.draw(st.permutations(list(tiers))):
        size = data.draw(st.integers(100, 9000))
        pair.offer(pair.robot, f"robot/{name}", bytes([tiers[name]]) * size, pumped=False)
    pair.pump(pair.robot)
    pair.advance(2 * S)
    order = [frame.data[0] for frame in message_frames(pair.robot)]
    assert order == sorted(order)
    assert set(order) == set(tiers.values())


# Beats, reports, clocks, wake-ups.


def test_an_idle_link_carries_a_beat_a_second_each_way_and_their_reports() -> None:
    pair = Pair()
    pair.advance(60 * S)
    for side in (pair.robot, pair.operator):
        hellos = [header for header, _ in side.decoded if header.elicits_report]
        assert 59 <= len(hellos) <= 61
        assert len(side.sent) <= 125
        assert 59 <= len(side.link_states) <= 61
    wire_bits = sum(len(d) + IP_UDP_BYTES for _, d in pair.robot.sent) * 8
    assert wire_bits / 60 < 1200


def test_reports_ride_on_datagrams_that_leave_anyway() -> None:
    pair = Pair()
    for _ in range(100):
        pair.offer(pair.robot, "robot/state/a", MESSAGE)
        pair.offer(pair.operator, "operator/state/b", MESSAGE)
        pair.advance(30 * MS)
    for side in (pair.robot, pair.operator):
        alone = [
            frames
            for _, frames in side.decoded
            if frames and not any(isinstance(f, MessageFrame) for f in frames)
        ]
        assert len(alone) <= 5
        assert len(side.frames(ReportFrame)) >= 90


def test_reports_tell_when_each_datagram_arrived() -> None:
    pair = Pair()
    for i in range(30):
        pair.offer(pair.robot, "robot/command/a", b"%d" % i)
        pair.advance((3 + i % 5) * MS)
    pair.advance(1 * S)
    told: dict[int, int] = {}
    for report in pair.operator.frames(ReportFrame):
        assert isinstance(report, ReportFrame)
        number, arrival_us = report.largest, report.arrival_us
        told[number] = arrival_us
        for numbers_before, us_before in report.earlier:
            number, arrival_us = number - numbers_before, arrival_us - us_before
            told[number] = arrival_us
    arrived = {
        header.number: pair.operator.local_ns(t + pair.robot.delay_ns) // 1000 & 0xFFFF_FFFF
        for (t, _), (header, _) in zip(pair.robot.sent, pair.robot.decoded, strict=True)
        if header.elicits_report and t + pair.robot.delay_ns < pair.now_ns - 100 * MS
    }
    assert len(arrived) >= 30
    assert {number: told.get(number) for number in arrived} == arrived


def test_pure_reports_take_a_small_share_of_a_thin_link() -> None:
    pair = Pair(bands=(THIN,))
    start_bytes = sum(len(d) + IP_UDP_BYTES for _, d in pair.operator.sent)
    for _ in range(20):
        saturate(pair)
        pair.advance(1 * S)
    report_bits = (sum(len(d) + IP_UDP_BYTES for _, d in pair.operator.sent) - start_bytes) * 8
    assert report_bits / 20 < 0.10 * THIN.rate_bps  # the way back carries nothing else


@pytest.mark.parametrize("operator_offset_ns", [0, -50 * HOUR, 1000 * HOUR])
def test_age_and_delay_are_right_with_clocks_hours_apart(operator_offset_ns: int) -> None:
    pair = Pair(operator_offset_ns=operator_offset_ns)
    pair.offer(pair.robot, "robot/state/pose", MESSAGE, age_ns=300 * MS)
    pair.advance(100 * MS)
    (event,) = pair.operator.delivered
    assert event.one_way_delay_ns == pytest.approx(50 * MS, abs=5000)
    assert event.age_ns == pytest.approx(350 * MS, abs=5000)
    captured_ns = UNIX_NS + pair.now_ns - 400 * MS
    assert event.capture_unix_ns == pytest.approx(captured_ns, abs=5000)


def test_the_age_of_a_parted_message_counts_until_its_last_part() -> None:
    pair = Pair()
    pair.offer(pair.robot, "robot/perception/image", bytes(23_750))  # 200 ms of the link
    pair.advance(1 * S)
    (event,) = pair.operator.delivered
    assert event.one_way_delay_ns == pytest.approx(255 * MS, abs=15 * MS)
    assert event.age_ns == event.one_way_delay_ns


def test_the_round_trip_leaves_out_how_long_the_peer_held_the_report() -> None:
    pair = Pair(bands=(THIN,), delay_ns=50 * MS)
    pair.offer(pair.robot, "robot/state/pose", MESSAGE)
    pair.advance(2 * S)
    assert pair.robot.endpoint.link_state().rtt_ns == pytest.approx(100 * MS, abs=5000)


def test_a_stepped_wall_clock_reaches_the_peer_with_the_next_beat() -> None:
    pair = Pair()
    local_ns = pair.robot.local_ns(pair.now_ns)
    pair.robot.endpoint.set_wall_clock(UNIX_NS + HOUR + pair.now_ns, local_ns)
    pair.advance(2 * S)
    pair.offer(pair.robot, "robot/state/pose", MESSAGE)
    pair.advance(50 * MS)
    assert pair.operator.delivered[-1].capture_unix_ns == pytest.approx(
        UNIX_NS + HOUR + pair.now_ns - 50 * MS, abs=5000
    )


def test_a_drained_endpoint_has_nothing_more_to_send_before_its_wake_up() -> None:
    pair = Pair()
    saturate(pair)
    for _ in range(200):
        pair.step()  # every pump asserts that the wake-up lies ahead
        for side in (pair.robot, pair.operator):
            now_ns = side.local_ns(pair.now_ns)
            assert side.endpoint.next_datagram(now_ns) is None
            assert side.endpoint.next_event() is None
            between_ns = (pair.now_ns + side.wakeup_ns) // 2
            if pair.now_ns < between_ns < side.wakeup_ns:
                assert side.endpoint.next_datagram(side.local_ns(between_ns)) is None
    assert len(pair.robot.sent) > 40


def test_topics_are_confirmed_a_handful_at_a_time() -> None:
    pair = Pair()
    for _ in range(2):
        for i in range(100):
            pair.offer(pair.robot, f"robot/command/{i}", MESSAGE, pumped=False)
        pair.pump(pair.robot)
        pair.advance(1 * S)
    assert len(pair.operator.delivered) == 200
    confirmed = [len(f.topic_ids) for f in pair.operator.frames(KnownFrame) if isinstance(f, KnownFrame)]
    assert max(confirmed) <= 32
    assert len(pair.robot.endpoint._outgoing._confirmed) == 100


def test_the_band_follows_the_measured_round_trip() -> None:
    pair = Pair(bands=(THIN, FAST), delay_ns=50 * MS)
    assert pair.robot.endpoint.link_state().band == "fast"
    saturate(pair, 100_000)
    pair.advance(1 * S)
    assert pair.operator.payloads == [bytes(100_000)]
    pair.robot.delay_ns = pair.operator.delay_ns = 500 * MS
    pair.advance(4 * S)
    assert pair.robot.endpoint.link_state().band == "thin"
    assert pair.robot.link_states[-1].rate_bps == 95_000
    pair.forget_history()
    saturate(pair, 400_000)
    start_ns = pair.now_ns
    pair.advance(5 * S)
    wire_bits = sum(len(d) + IP_UDP_BYTES for _, d in pair.robot.sent) * 8
    assert 0.9 * 95_000 < wire_bits * S / (pair.now_ns - start_ns) < 1.05 * 95_000


def test_two_runs_of_one_story_send_the_same_bytes() -> None:
    def run() -> list[tuple[int, bytes]]:
        pair = Pair()
        for i in range(30):
            pair.offer(pair.robot, f"robot/state/{i % 3}", bytes(i * 100))
            pair.offer(pair.operator, "operator/command/a", MESSAGE)
            pair.advance(17 * MS)
        return pair.robot.sent + pair.operator.sent

    assert run() == run()


def test_a_rule_with_a_rate_limits_what_leaves() -> None:
    rule = TopicRule("robot/state/**", DEFAULT_CLASSES["state"], min_period_ns=200 * MS)
    pair = Pair(rules=(rule,))
    for _ in range(1000):
        pair.offer(pair.robot, "robot/state/joints", MESSAGE)
        pair.advance(3 * MS)
    assert 15 <= len(message_frames(pair.robot)) <= 16


@pytest.mark.parametrize(("characters", "is_sent"), [(10, True), (29, False), (150, False)])
def test_a_name_is_measured_in_bytes_and_never_blocks_the_link(characters: int, is_sent: bool) -> None:
    pair = Pair(bands=(THIN,))
    key = "robot/state/" + "\N{ROBOT FACE}" * characters
    pair.offer(pair.robot, key, MESSAGE, encoding="application/protobuf;" + "schema" * 3)
    pair.offer(pair.robot, "robot/bulk/log", MESSAGE)
    pair.advance(1 * S)
    assert pair.operator.payloads == [MESSAGE] * (2 if is_sent else 1)
    assert pair.robot.endpoint.counters_dict()["refused_offers"] == (0 if is_sent else 1)

"""A peer that is broken, old, forged or hostile: nothing escapes, nothing grows, nothing stays broken."""

from dataclasses import replace

import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from messages.attachment import Stamp
from shaper.datagram import decode_datagram
from shaper.endpoint import Endpoint
from shaper.endpoint_settings import EndpointSettings
from shaper.events import Delivered, Event
from shaper.frames import (
    Frame,
    Header,
    HelloFrame,
    KnownFrame,
    LedgerFrame,
    MessageFrame,
    Outcome,
    ReceiptFrame,
    ReportFrame,
    SkipFrame,
    TopicName,
)
from shaper.incoming import Limits
from shaper.link_estimator import PresetBands
from shaper.pump import pump
from shaper.shared_state import encode_entries
from tests.shaper.pair import FAST, HOUR, MS, RULES, THIN, UNIX_NS, Pair, S, Side
from tests.shaper.wire import FRAMES, encode

OWN_EPOCH = 7
PEER_EPOCH = 9
LIMITS = Limits(max_topics=8, max_message_bytes=5_000, max_reassembly_bytes=10_000)
NAME = TopicName("operator/a", "")


class Victim:
    """One endpoint, and datagrams made up by hand."""

    def __init__(self, limits: Limits = LIMITS) -> None:
        self.now_ns = 5 * HOUR
        self.endpoint = Endpoint(
            EndpointSettings(RULES, limits=limits), PresetBands((THIN, FAST)), OWN_EPOCH, self.now_ns, UNIX_NS
        )
        self.events: list[Event] = []
        self.sent: list[bytes] = []
        self.number = 0

    def receive(self, *frames: Frame, epoch: int = PEER_EPOCH, number: int | None = None) -> None:
        self.number += 1
        header = Header(epoch, self.number if number is None else number, self.now_ns // 1000, True)
        self.receive_raw(encode(header, list(frames)))

    def receive_raw(self, datagram: bytes) -> None:
        self.endpoint.receive_datagram(datagram, self.now_ns)
        self.pump()

    def pump(self) -> None:
        def send(datagram: bytes) -> None:
            self.sent.append(datagram)
            assert len(datagram) <= 1200

        wakeup_ns = pump(self.endpoint, self.now_ns, send, self.events.append)
        assert wakeup_ns > self.now_ns, "the pump would spin"

    def advance(self, duration_ns: int) -> None:
        self.now_ns += duration_ns
        self.endpoint.on_timer(self.now_ns)
        self.pump()

    @property
    def payloads(self) -> list[bytes]:
        return [e.payload for e in self.events if isinstance(e, Delivered)]


def deliver_forged(side: Side, pair: Pair, header: Header, *frames: Frame) -> None:
    """The link brings a datagram that the other side never sent."""
    pair.receive(side, encode(header, list(frames)))


# Nothing escapes.


@settings(max_examples=150)
@given(
    st.lists(
        st.tuples(
            st.sampled_from([PEER_EPOCH, PEER_EPOCH, PEER_EPOCH, 10]),
            st.integers(0, 0xFF_FFFF),
            st.integers(0, 0xFFFF_FFFF),
            st.lists(FRAMES, max_size=3),
            st.integers(0, 2 * S),
        ),
        max_size=12,
    )
)
def test_no_well_formed_datagram_raises_spins_or_grows(
    datagrams: list[tuple[int, int, int, list[Frame], int]],
) -> None:
    victim = Victim()
    for epoch, number, stamp_us, frames, gap_ns in datagrams:
        aimed = [
            f._replace(epoch=OWN_EPOCH, largest=f.largest % 4)
            if isinstance(f, ReportFrame)
            else replace(f, epoch=OWN_EPOCH)
            if isinstance(f, KnownFrame | ReceiptFrame | LedgerFrame)
            else f
            for f in frames
        ]
        victim.receive_raw(encode(Header(epoch, number, stamp_us, True), aimed))
        now_ns = victim.now_ns
        victim.endpoint.offer("robot/state/a", bytes(700), now_ns, now_ns)
        victim.pump()
        victim.advance(gap_ns)
        incoming = victim.endpoint._incoming
        assert incoming is None or incoming.held_bytes <= 3 * LIMITS.max_reassembly_bytes
        assert victim.endpoint.link_state().loss_ratio <= 1
    for event in victim.events:
        if isinstance(event, Delivered) and event.capture_unix_ns is not None:
            Stamp(event.capture_unix_ns, event.number).encode()  # what the daemon does with it


@given(st.binary(max_size=60))
def test_no_bytes_raise(data: bytes) -> None:
    victim = Victim()
    for datagram in (data, b"\x11" + data, encode(Header(PEER_EPOCH, 0, 0, True), []) + data):
        victim.receive_raw(datagram)
    assert victim.endpoint.counters.received_datagrams == 3


def test_malformed_datagrams_are_counted_and_change_nothing() -> None:
    victim = Victim()
    for datagram in (b"", b"\x01", b"\xff" * 40, encode(Header(PEER_EPOCH, 0, 0, True), []) + b"\x07"):
        victim.receive_raw(datagram)
    assert victim.endpoint.counters.malformed == 4
    assert victim.endpoint.holding
    assert len(victim.events) == 1  # the link state of its own first beat


@pytest.mark.parametrize(
    "bomb",
    [
        zstandard.ZstdCompressor(level=19).compress(bytes(50_000_000)),
        zstandard.ZstdCompressor(write_content_size=False).compress(bytes(6000)),
        b"\x28\xb5\x2f\xfd" + b"\xff" * 20,
        b"",
    ],
    ids=["declared", "undeclared", "garbage", "empty"],
)
def test_a_hostile_zstd_payload_is_malformed_and_the_topic_goes_on(bomb: bytes) -> None:
    victim = Victim(Limits(max_message_bytes=5_000))
    victim.receive(MessageFrame(0, 1, 0, bomb[:1100], name=NAME, compressed=True))
    victim.receive(MessageFrame(0, 2, 0, b"good", name=NAME))
    assert victim.endpoint.counters.malformed == 1
    assert victim.payloads == [b"good"]


@pytest.mark.parametrize("unix_ns", [-(1 << 63), 0, (1 << 62), (1 << 63) - 1])
def test_an_absurd_wall_clock_gives_no_capture_time_that_cannot_be_written(unix_ns: int) -> None:
    victim = Victim()
    victim.receive(HelloFrame(unix_ns))
    victim.advance(2 * S)
    victim.receive(MessageFrame(0, 1, 3_000_000, b"late", name=NAME))
    victim.receive(MessageFrame(0, 2, 0, b"new", name=NAME))
    for event in victim.events:
        if isinstance(event, Delivered):
            assert event.capture_unix_ns is None or 0 <= event.capture_unix_ns <= 1 << 62
    assert victim.payloads == [b"late", b"new"]


def test_a_topic_id_that_is_named_anew_is_malformed() -> None:
    victim = Victim()
    victim.receive(MessageFrame(0, 1, 0, b"a", name=NAME))
    victim.receive(MessageFrame(0, 2, 0, b"b", name=TopicName("operator/b", "")))
    assert victim.payloads == [b"a"]
    assert victim.endpoint.counters.malformed == 1


def test_a_message_of_an_unnamed_topic_is_counted() -> None:
    victim = Victim()
    victim.receive(MessageFrame(3, 1, 0, b"a"))
    assert victim.payloads == []
    assert victim.endpoint.counters_dict()["unknown_topics"] == 1


@pytest.mark.parametrize("key", ["", "/a", "a//b", "a/*", "**", "a?", "a/$*", "@/admin"])
def test_a_name_that_is_no_key_is_never_delivered(key: str) -> None:
    victim = Victim()
    victim.receive(MessageFrame(0, 1, 0, b"a", name=TopicName(key, "")))
    assert victim.payloads == []
    assert victim.endpoint.received_ledgers == {}


def test_a_message_beside_one_topic_too_many_is_delivered() -> None:
    victim = Victim()
    for i in range(LIMITS.max_topics):
        victim.receive(MessageFrame(i, 0, 0, b"first", name=TopicName(f"operator/{i}", "")))
    victim.receive(
        MessageFrame(99, 0, 0, b"too many", name=TopicName("operator/99", "")),
        MessageFrame(0, 1, 0, b"innocent", name=TopicName("operator/0", "")),
    )
    assert victim.payloads == [b"first"] * 8 + [b"innocent"]
    assert victim.endpoint.counters_dict()["refused_messages"] == 1
    incoming = victim.endpoint._incoming
    assert incoming is not None and len(incoming._topics) == LIMITS.max_topics


# Hostile reports.


def test_a_report_of_a_negative_round_trip_moves_neither_clock_nor_band() -> None:
    pair = Pair(bands=(FAST, THIN), delay_ns=500 * MS)
    pair.robot.endpoint.link_state()
    before = pair.robot.endpoint.link_state()
    incoming = pair.robot.endpoint._incoming
    assert incoming is not None and before.band == "thin"
    offset_ns = incoming.clock.offset_ns
    pair.offer(pair.robot, "robot/state/a")
    header, _ = pair.robot.decoded[-1]
    sent_us = pair.operator.local_ns(pair.now_ns) // 1000
    forged = ReportFrame(header.epoch, header.number, (sent_us - 600_000_000) & 0xFFFF_FFFF, 1)
    number = pair.operator.endpoint._path.next_number
    deliver_forged(pair.robot, pair, Header(incoming.epoch, number, sent_us, False), forged)

    assert incoming.clock.offset_ns == offset_ns
    assert pair.robot.endpoint.link_state().band == "thin"
    assert (pair.robot.endpoint.link_state().rtt_ns or 0) > 0


def test_confirmations_of_ids_that_do_not_exist_are_ignored() -> None:
    victim = Victim()
    victim.receive(KnownFrame(OWN_EPOCH, tuple(range(500))))
    victim.endpoint.offer("robot/state/a", b"x", victim.now_ns, victim.now_ns)
    victim.pump()
    frames = [f for d in victim.sent for f in decode_datagram(d)[1] if isinstance(f, MessageFrame)]
    assert [f.name is not None for f in frames] == [True]


def test_confirmations_to_a_former_life_are_ignored() -> None:
    victim = Victim()
    victim.receive(HelloFrame(UNIX_NS))
    for epoch in (OWN_EPOCH + 1, OWN_EPOCH + 1, OWN_EPOCH):
        victim.endpoint.offer("robot/command/a", b"x", victim.now_ns, victim.now_ns)
        victim.advance(100 * MS)
        victim.receive(KnownFrame(epoch, (0,)))
    victim.endpoint.offer("robot/command/a", b"x", victim.now_ns, victim.now_ns)
    victim.advance(100 * MS)
    frames = [f for d in victim.sent for f in decode_datagram(d)[1] if isinstance(f, MessageFrame)]
    assert [f.name is not None for f in frames] == [True, True, True, False]


# Nothing grows.


def test_parts_of_messages_that_never_become_whole_hold_bounded_memory() -> None:
    victim = Victim()
    for i in range(2000):
        victim.receive(MessageFrame(0, i, 0, b"x", i % 50, 4000, name=NAME))
        incoming = victim.endpoint._incoming
        assert incoming is not None and incoming.held_bytes <= LIMITS.max_reassembly_bytes


def test_reliable_messages_with_gaps_hold_bounded_memory_on_however_many_topics() -> None:
    victim = Victim()
    for i in range(3000):
        name = TopicName(f"operator/{i % 8}", "")
        victim.receive(
            MessageFrame(i % 8, i * 37 & 0xFFFF, 0, bytes(900), name=name, reliable=True, back=i % 60)
        )
        incoming = victim.endpoint._incoming
        assert incoming is not None and incoming.held_bytes <= LIMITS.max_reassembly_bytes + 1000
        assert len(incoming._receipts) <= 4096


def test_states_of_ever_new_entries_hold_bounded_memory() -> None:
    victim = Victim()
    for i in range(500):
        name = TopicName(f"operator/{i % 8}", "")
        entries = encode_entries({1 + i * 10 + n: bytes(80) for n in range(10)}, whole=False)
        victim.receive(MessageFrame(i % 8, i, 0, entries, name=name, reliable=True, latest=True))
        incoming = victim.endpoint._incoming
        assert incoming is not None and incoming.held_bytes <= LIMITS.max_reassembly_bytes


def test_receipts_for_messages_that_never_were_change_nothing() -> None:
    victim = Victim()
    victim.receive(HelloFrame(UNIX_NS))
    for number in (0, 1, 77, 65535):
        victim.receive(ReceiptFrame(OWN_EPOCH, ((0, number, Outcome.DELIVERED), (9, 0, Outcome.EXPIRED))))
    victim.endpoint.offer("robot/command/a", b"x", victim.now_ns, victim.now_ns)
    victim.pump()
    victim.receive(ReceiptFrame(OWN_EPOCH, ((0, 5, Outcome.DELIVERED), (3, 0, Outcome.DELIVERED))))
    victim.receive(ReceiptFrame(OWN_EPOCH + 1, ((0, 0, Outcome.DELIVERED),)))
    assert victim.endpoint.sent_ledgers()["robot/command/a"].queued == 1
    victim.advance(100 * MS)
    victim.receive(ReceiptFrame(OWN_EPOCH, ((0, 0, Outcome.DELIVERED),) * 3))
    ledger = victim.endpoint.sent_ledgers()["robot/command/a"]
    assert (ledger.queued, ledger.sent) == (0, 1)


@pytest.mark.parametrize("ahead", [100, 1000, 30_000])
def test_a_skip_far_ahead_passes_over_no_more_than_a_window(ahead: int) -> None:
    victim = Victim()
    victim.receive(MessageFrame(0, 0, 0, b"first", name=NAME, reliable=True))
    victim.receive(SkipFrame(0, ahead))
    incoming = victim.endpoint._incoming
    assert incoming is not None and len(incoming._receipts) <= 130
    victim.receive(SkipFrame(7, ahead))
    assert victim.endpoint.counters_dict()["unknown_topics"] == 1
    assert victim.payloads == [b"first"]


def test_a_peer_that_keeps_restarting_leaves_no_more_ledgers_than_topics() -> None:
    victim = Victim()
    for life in range(100):
        victim.receive(
            HelloFrame(UNIX_NS),
            *(MessageFrame(i, 0, 0, b"x", name=TopicName(f"operator/{life}/{i}", "")) for i in range(8)),
            epoch=1000 + life,
        )
    assert len(victim.endpoint.received_ledgers) <= LIMITS.max_topics


# Nothing stays broken.


@pytest.mark.parametrize(
    "frames",
    [
        (),
        (MessageFrame(0, 1, 0, b"a", name=NAME),),
    ],
    ids=["empty", "message"],
)
def test_one_forged_epoch_does_not_shut_the_peer_out(frames: tuple[Frame, ...]) -> None:
    pair = Pair()
    deliver_forged(pair.operator, pair, Header(60_000, 0, 0, True), *frames)
    pair.advance(2 * S)
    pair.offer(pair.robot, "robot/command/a", b"still here")
    pair.advance(1 * S)
    assert pair.operator.payloads == [b"still here"]


def test_one_forged_hello_shuts_the_peer_out_for_a_few_seconds_and_no_longer() -> None:
    """Whoever says hello is believed until datagrams are authenticated; but then it has to go on."""
    pair = Pair()
    pair.offer(pair.robot, "robot/state/a", b"before")
    pair.advance(1 * S)
    deliver_forged(pair.operator, pair, Header(60_000, 0, 0, True), HelloFrame(UNIX_NS))
    pair.offer(pair.robot, "robot/command/a", b"meanwhile")
    pair.advance(6 * S)
    pair.offer(pair.robot, "robot/state/a", b"still here")
    pair.advance(1 * S)
    assert pair.operator.payloads == [b"before", b"meanwhile", b"still here"]


def test_one_forged_packet_number_does_not_shut_the_peer_out() -> None:
    pair = Pair()
    header, _ = pair.robot.decoded[-1] if pair.robot.sent else (Header(101, 0, 0, True), None)
    ahead = pair.robot.endpoint._path.next_number + (1 << 22)
    sent_us = pair.robot.local_ns(pair.now_ns) // 1000
    deliver_forged(pair.operator, pair, Header(header.epoch, ahead, sent_us, True))
    pair.advance(2 * S)
    pair.offer(pair.robot, "robot/command/a", b"still here")
    pair.advance(1 * S)
    assert pair.operator.payloads == [b"still here"]
    assert not pair.robot.endpoint.holding


@pytest.mark.parametrize("lost", [40_000, 65_000, 65_536])
def test_a_topic_goes_on_after_any_number_of_its_messages_was_lost(lost: int) -> None:
    """A heartbeat of 10 Hz counts 36 000 in a blackout of an hour; message numbers have 16 bits."""
    victim = Victim()
    victim.receive(MessageFrame(0, 500, 0, b"before", name=NAME, latest=True))
    for i in range(300):
        number = (501 + lost + i) & 0xFFFF
        victim.receive(MessageFrame(0, number, 0, b"after", name=NAME, latest=True))
    assert victim.payloads.count(b"after") >= 299


def test_ages_are_right_after_a_blackout_longer_than_half_the_range_of_the_stamps() -> None:
    pair = Pair()
    pair.robot.loses = pair.operator.loses = lambda datagram: True
    pair.advance(45 * 60 * S)
    pair.robot.loses = pair.operator.loses = lambda datagram: False
    pair.forget_history()
    pair.offer(pair.robot, "robot/heartbeat", b"x")
    pair.advance(50 * MS)
    (event,) = pair.operator.delivered
    assert event.age_ns == pytest.approx(50 * MS, abs=200 * MS)


def test_reordering_is_not_taken_for_loss() -> None:
    pair = Pair()
    for i in range(300):
        pair.offer(pair.robot, "robot/command/a", b"%d" % i)
        pair.advance(10 * MS)
        if i % 2:
            pair.robot.underway.sort(key=lambda item: -item[0])
            pair.transfer(pair.robot)
    pair.advance(2 * S)
    assert len(pair.operator.delivered) == 300
    assert pair.robot.endpoint.link_state().loss_ratio < 0.02

"""A link without a way back: what is held goes round, newest first, at a fixed rate."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shaper.carousel import Carousel, CarouselSettings, CarouselTopic
from shaper.carousel_receiver import CarouselReceiver
from shaper.carousel_wire import (
    CarouselMessage,
    Chunk,
    decode_chunk,
    decode_message,
    encode_chunk,
    encode_message,
)
from shaper.errors import DecodeError
from shaper.events import Delivered
from shaper.frames import IP_UDP_BYTES
from shaper.incoming import Limits
from shaper.ledger import ReceivedLedger, SentLedger

MS = 1_000_000
S = 1_000_000_000
RATE_BPS = 3_000_000
TOPICS = (CarouselTopic("log/**", latest=False), CarouselTopic("short/*", ttl_ns=2 * S), CarouselTopic("**"))
SETTINGS = CarouselSettings(TOPICS, RATE_BPS, repeat_ns=S // 2, max_datagram_bytes=1200)


class Link:
    """A carousel, a way that is open or not, and a receiver. Time moves by `run`."""

    def __init__(self, carousel_settings: CarouselSettings = SETTINGS, limits: Limits | None = None) -> None:
        self.carousel = Carousel(carousel_settings, life=7, now_ns=0)
        self.receiver = CarouselReceiver(limits or Limits(), ("**",), {}, lambda stamp_us, now_ns: None)
        self.now_ns = 0
        self.open = True
        self.loss_ratio = 0.0
        self.random = random.Random(1)
        self.delivered: list[Delivered] = []
        self.sent: list[tuple[int, bytes]] = []

    def offer(self, key: str, payload: bytes = b"x") -> bool:
        return self.carousel.offer(key, payload, "raw", self.now_ns, 1_000 * S + self.now_ns, self.now_ns)

    def run(self, duration_ns: int) -> None:
        until_ns = self.now_ns + duration_ns
        while self.now_ns < until_ns:
            while (body := self.carousel.next_datagram(self.now_ns)) is not None:
                self.sent.append((self.now_ns, body))
                if self.open and self.random.random() >= self.loss_ratio:
                    delivered = self.receiver.receive(body, self.now_ns)
                    self.delivered += [] if delivered is None else [delivered]
            wakeup_ns = self.carousel.wakeup_at_ns(self.now_ns)
            assert wakeup_ns > self.now_ns, "a drained carousel asks to be woken now: it would spin"
            self.now_ns = min(until_ns, wakeup_ns)

    def ledger(self, key: str) -> SentLedger:
        return self.carousel.ledgers[key]

    @property
    def keys(self) -> list[str]:
        return [each.key for each in self.delivered]


def test_a_message_is_delivered_once_however_often_it_goes_round() -> None:
    link = Link()
    link.offer("image", bytes(range(256)) * 20)
    link.run(5 * S)
    assert [(d.key, d.payload, d.encoding) for d in link.delivered] == [
        ("image", bytes(range(256)) * 20, "raw")
    ]
    assert link.carousel.counters.carousel_rounds == 10
    assert link.delivered[0].capture_unix_ns == 1_000 * S


def test_whatever_is_held_arrives_in_any_window_as_long_as_a_round() -> None:
    """The link opens at any moment, for as long as a round takes: everything is there."""
    for opens_after_ms in range(0, 1000, 90):
        link = Link()
        link.open = False
        for camera in range(8):
            link.offer(f"camera/{camera}", bytes(18_000))
        link.run((3000 + opens_after_ms) * MS)
        link.open = True
        link.run(SETTINGS.repeat_ns)
        assert len(link.keys) == 8, opens_after_ms


def test_what_is_newest_leaves_first() -> None:
    link = Link()
    link.open = False
    for number in range(10):
        link.offer(f"camera/{number}", bytes(5_000))
        link.run(S // 10)
    while link.carousel.wakeup_at_ns(link.now_ns) <= link.now_ns + 10 * MS:  # until the round has ended
        link.run(10 * MS)
    link.open = True
    link.run(SETTINGS.repeat_ns + 100 * MS)
    assert link.keys == [f"camera/{number}" for number in reversed(range(10))]


def test_a_new_message_does_not_wait_for_a_round_to_end() -> None:
    link = Link()
    link.offer("big", bytes(140_000))
    link.run(100 * MS)
    link.offer("first", b"waits until what is leaving has left")
    link.run(500 * MS)  # in the midst of a round
    assert link.keys == ["big", "first"]
    link.offer("second", b"now")
    link.run(5 * MS)
    assert link.keys == ["big", "first", "second"]


@pytest.mark.parametrize("keep_all", [False, True])
def test_with_more_offered_than_the_link_carries_whole_messages_still_arrive(keep_all: bool) -> None:
    topics = (CarouselTopic("scan", latest=not keep_all), CarouselTopic("image", latest=not keep_all))
    link = Link(replace(SETTINGS, topics=topics))
    for number in range(200):  # 40 scans and 20 images a second, some three times the rate
        link.offer("scan", bytes(15_000))
        if number % 2:
            link.offer("image", bytes(30_000))
        link.run(25 * MS)
        for key, ledger in link.carousel.ledgers.items():
            assert ledger.queued >= 0, key
    arrived_bytes = sum(len(d.payload) for d in link.delivered)
    assert 8 * arrived_bytes > 0.85 * RATE_BPS * link.now_ns / S
    assert set(link.keys) == {"scan", "image"}
    link.run(10 * S)
    assert all(ledger.queued == 0 for ledger in link.carousel.ledgers.values())


def test_a_newer_sample_takes_the_place_of_the_older_one() -> None:
    link = Link()
    link.open = False
    for number in range(5):
        link.offer("pose", bytes([number]))
        link.run(10 * MS)
    link.open = True
    link.run(S)
    assert [d.payload for d in link.delivered] == [b"\x04"]
    assert link.ledger("pose").superseded == 0  # each left at least once


def test_where_all_count_a_window_brings_what_was_captured_in_the_dark() -> None:
    link = Link()
    link.open = False
    for _ in range(20):
        link.offer("log/a", bytes(4_000))
        link.run(S // 2)
    link.open = True
    link.run(SETTINGS.repeat_ns)
    assert sorted(d.number for d in link.delivered) == list(range(20))


def test_no_more_is_held_than_a_round_carries_and_the_oldest_gives_way() -> None:
    link = Link()
    link.open = False
    for _ in range(60):
        link.offer("log/a", bytes(10_000))
        assert link.carousel.held_bytes <= SETTINGS.held_bytes
        link.run(S // 10)
    link.open = True
    link.run(SETTINGS.repeat_ns)
    held = len(link.delivered)
    assert 10 < held < 20
    assert sorted(d.number for d in link.delivered) == list(range(60 - held, 60))


def test_every_message_is_in_exactly_one_counter() -> None:
    link = Link()
    link.open = False
    for number in range(400):
        link.offer(("log/a", "pose", "short/b", "big")[number % 4], bytes(4_000 * (1 + number % 4)))
        link.run(10 * MS if number < 300 else 100 * MS)
        for ledger in link.carousel.ledgers.values():
            assert ledger.queued >= 0
    link.run(5 * S)
    ledgers = link.carousel.ledgers
    assert sum(ledger.offered for ledger in ledgers.values()) == 400
    assert all(ledger.queued == 0 for ledger in ledgers.values())
    assert ledgers["big"].superseded > 0 and ledgers["log/a"].overflow > 0


def test_more_than_the_link_carries_is_told_and_not_held() -> None:
    link = Link()
    assert not link.offer("huge", bytes(SETTINGS.held_bytes))
    assert link.ledger("huge").refused == 1
    link.run(S)
    assert link.sent == []


def test_the_rate_on_the_wire_is_never_exceeded() -> None:
    link = Link()
    for number in range(100):
        link.offer(f"log/{number}", bytes(7_000))
        link.run(20 * MS)
    outer_bytes = 8 + IP_UDP_BYTES
    for begin_ns in range(0, link.now_ns, 50 * MS):
        sent = [b for at_ns, b in link.sent if begin_ns <= at_ns < begin_ns + 50 * MS]
        bits = 8 * sum(len(body) + outer_bytes for body in sent)
        assert bits <= RATE_BPS * 0.054 + 8 * 1228
    total_bits = 8 * sum(len(body) + outer_bytes for _, body in link.sent)
    assert total_bits > 0.9 * RATE_BPS * link.now_ns / S
    assert total_bits == 8 * link.carousel.counters.carousel_wire_bytes


def test_one_in_five_datagrams_lost_costs_rounds_but_no_message() -> None:
    link = Link()
    link.loss_ratio = 0.2
    for number in range(10):
        link.offer(f"camera/{number}", bytes(14_000))
    link.run(3 * S)
    assert len(link.keys) == 10


def test_what_is_too_old_goes_round_no_longer_and_is_not_delivered() -> None:
    link = Link()
    link.open = False
    link.offer("short/a")
    link.run(2 * S + 600 * MS)
    link.open = True
    link.run(S)
    assert link.keys == [] and link.carousel.held_bytes == 0
    ledgers: dict[str, ReceivedLedger] = {}
    late = CarouselReceiver(Limits(), ("**",), ledgers, lambda stamp_us, now_ns: 2 * S + 1)
    assert late.receive(link.sent[0][1], 0) is None
    assert ledgers["short/a"].expired == 1


def test_an_empty_carousel_and_one_that_waits_for_its_round_are_silent() -> None:
    link = Link()
    assert link.carousel.wakeup_at_ns(0) > 1 << 60
    link.offer("a")
    link.run(10 * S)
    assert len(link.sent) in (20, 21)  # once as it is new, then in each round


def test_decimation_takes_one_sample_per_period() -> None:
    decimated = replace(SETTINGS, topics=(CarouselTopic("**", min_period_ns=S),))
    link = Link(decimated)
    for _ in range(40):
        link.offer("camera")
        link.run(S // 10)
    assert link.ledger("camera").decimated == 36
    assert len(link.delivered) == 4


def test_keys_that_no_topic_names_stay_here() -> None:
    link = Link(replace(SETTINGS, topics=(CarouselTopic("camera/**"),)))
    assert not link.offer("joint_states")
    assert link.carousel.topic_of("joint_states") is None


def test_overload_does_not_grow_the_turns() -> None:
    link = Link()
    for number in range(20_000):
        link.offer("pose", number.to_bytes(4, "little"))
    assert len(link.carousel._turns) <= 2 * 1 + 17
    link.run(S)
    assert link.delivered[0].payload == (19_999).to_bytes(4, "little")


# The receiver, whose sender is authentic but may be mad.


def test_what_a_sender_makes_us_hold_is_bounded_and_the_newest_is_kept() -> None:
    limits = Limits(max_reassembly_bytes=50_000, max_message_bytes=20_000, max_unfinished_messages=10)
    receiver = CarouselReceiver(limits, ("**",), {}, lambda stamp_us, now_ns: None)
    for message in range(1000):
        receiver.receive(encode_chunk(Chunk(7, message, 0, 50, bytes(900))), 0)
        assert receiver.held_bytes <= 50_000
    assert receiver.counters.carousel_given_up == 990
    for index in range(50):
        receiver.receive(encode_chunk(Chunk(7, 5000, index, 50, bytes(900))), 0)
    assert (
        receiver.counters.carousel_malformed == 1
    )  # it is larger than a message may be; the rest is passed over
    assert receiver.held_bytes <= 50_000


def test_a_restarted_sender_is_heard_and_its_former_life_is_not() -> None:
    receiver = CarouselReceiver(Limits(), ("**",), {}, lambda stamp_us, now_ns: None)
    blob = encode_message(CarouselMessage("a", "", b"x", 0, 0, 0, True))

    def receive(life: int, message: int) -> bool:
        return receiver.receive(encode_chunk(Chunk(life, message, 0, 1, blob)), 0) is not None

    assert receive(1, 90) and not receive(1, 90)
    assert receive(2, 0)
    assert not receive(1, 91)
    assert receive(2, 1)


def test_an_older_sample_that_becomes_whole_later_is_not_delivered() -> None:
    ledgers: dict[str, ReceivedLedger] = {}
    receiver = CarouselReceiver(Limits(), ("**",), ledgers, lambda stamp_us, now_ns: None)
    blob = encode_message(CarouselMessage("a", "", bytes(100), 0, 0, 0, True))
    assert receiver.receive(encode_chunk(Chunk(1, 1, 0, 1, blob)), 0) is not None
    assert receiver.receive(encode_chunk(Chunk(1, 0, 0, 1, blob)), 0) is None
    assert ledgers["a"].stale == 1


def test_keys_that_are_not_accepted_are_counted() -> None:
    receiver = CarouselReceiver(Limits(), ("camera/**",), {}, lambda stamp_us, now_ns: None)
    for message, key in enumerate(("joints", "camera/*", "")):
        blob = encode_message(CarouselMessage(key, "", b"x", 0, 0, 0, True))
        assert receiver.receive(encode_chunk(Chunk(1, message, 0, 1, blob)), 0) is None
    assert receiver.counters.carousel_refused == 3


def test_what_was_done_with_long_ago_is_forgotten_but_not_delivered_again() -> None:
    receiver = CarouselReceiver(Limits(), ("**",), {}, lambda stamp_us, now_ns: None)
    blob = encode_message(CarouselMessage("a", "", b"", 0, 0, 0, False))
    for message in range(66_000):
        assert receiver.receive(encode_chunk(Chunk(1, message, 0, 1, blob)), 0) is not None
    assert len(receiver._done) <= 65_536
    assert receiver.receive(encode_chunk(Chunk(1, 3, 0, 1, blob)), 0) is None


@given(
    st.builds(
        CarouselMessage,
        st.text(max_size=40),
        st.text(max_size=40),
        st.binary(max_size=200),
        st.integers(0, (1 << 32) - 1),
        st.integers(0, 1 << 62),
        st.integers(0, (1 << 32) - 1),
        st.booleans(),
    )
)
def test_a_message_reads_back(message: CarouselMessage) -> None:
    assert decode_message(encode_message(message)) == message


@settings(max_examples=200)
@given(st.binary(max_size=80))
def test_bytes_of_a_peer_never_raise_past_the_receiver(body: bytes) -> None:
    receiver = CarouselReceiver(Limits(), ("**",), {}, lambda stamp_us, now_ns: None)
    receiver.receive(body, 0)
    receiver.receive(encode_chunk(Chunk(1, 1, 0, 1, body or b"x")), 0)
    for decode in (decode_chunk, decode_message):
        try:
            decode(body)
        except DecodeError as error:
            assert str(error)


@pytest.mark.parametrize("body", [b"", bytes(10), encode_chunk(Chunk(1, 2, 3, 3, b"x"))])
def test_a_part_that_cannot_be_is_counted(body: bytes) -> None:
    receiver = CarouselReceiver(Limits(), ("**",), {}, lambda stamp_us, now_ns: None)
    assert receiver.receive(body, 0) is None
    assert receiver.counters.carousel_malformed == 1

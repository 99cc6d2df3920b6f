"""Each end knows what the other takes its direction for."""

from __future__ import annotations

from dataclasses import replace

from hypothesis import given
from hypothesis import strategies as st

from shaper.datagram import append_estimate
from shaper.estimate_exchange import STALE_NS, EstimateExchange
from shaper.events import LinkState
from shaper.frames import EstimateFrame
from shaper.trace_records import event_record
from tests.shaper.pair import FAST, THIN, Pair, S


def state(band: str = "fast", rate_bps: int = 950_000, queue_ns: int = 12_345_678) -> LinkState:
    return LinkState(rate_bps, band, 1, 0, 0, 0.1, False, queue_ns, 0.7)


def test_both_ends_see_both_directions() -> None:
    pair = Pair(bands=(FAST, THIN))
    pair.advance(3 * S)
    for side, other in ((pair.robot, pair.operator), (pair.operator, pair.robot)):
        told, own = side.endpoint.link_state().receiving, other.endpoint.link_state()
        assert told is not None
        assert (told.rate_bps, told.band, told.holding) == (own.rate_bps, own.band, own.holding)
        assert told.confidence == own.confidence == 1.0


def test_it_takes_less_than_a_sixth_of_a_percent_of_the_thin_band() -> None:
    exchange = EstimateExchange()
    told_bytes = 0
    for second in range(100):
        out = bytearray()
        estimate = exchange.take(state("100 kbit/s 500 ms"), second * S)
        assert estimate is not None
        append_estimate(out, estimate)
        assert len(out) <= 28
        told_bytes += len(out)
    assert told_bytes * 8 / 100 < 100_000 / 600


def test_that_the_link_is_held_is_told_once() -> None:
    exchange = EstimateExchange()
    held = replace(state("hold"), holding=True)
    told = [exchange.take(held, second * S) is not None for second in range(33)]
    assert told == [True] + 32 * [False]
    assert exchange.take(state(), 33 * S) is not None


def test_a_peer_that_is_silent_tells_nothing() -> None:
    pair = Pair()
    pair.advance(3 * S)
    assert pair.robot.endpoint.link_state().receiving is not None
    pair.operator.loses = lambda datagram: True
    pair.advance(STALE_NS + 3 * S)
    assert pair.robot.endpoint.link_state().receiving is None


def test_a_restarted_peer_is_not_taken_for_its_former_self() -> None:
    pair = Pair()
    pair.advance(3 * S)
    pair.operator.loses = lambda datagram: True
    pair.restart(pair.operator)
    pair.advance(1 * S)
    pair.operator.loses = lambda datagram: False
    pair.advance(5 * S)
    told = pair.robot.endpoint.link_state().receiving
    assert told is not None and told.band == "fast"


@given(st.lists(st.booleans(), min_size=60, max_size=60), st.integers(0, 50))
def test_a_name_that_was_lost_comes_again(lost: list[bool], changes_at: int) -> None:
    """After a change the name is wrong no longer than until one of the datagrams that carry it arrives."""
    ours, theirs = EstimateExchange(), EstimateExchange()
    frames = [ours.take(state("thin" if i >= changes_at else "fast"), i * S) for i in range(60)]
    for i, frame in enumerate(frames):
        if lost[i]:
            continue
        theirs.on_frame(frame, i * S)
        named = any(f.band == "thin" and not gone for f, gone in zip(frames[: i + 1], lost, strict=False))
        assert theirs.theirs is not None
        assert (theirs.theirs.band == "thin") == named
    assert sum(frame.band is not None for frame in frames[changes_at:]) >= (60 - changes_at) // 8


@given(st.floats(-1, 2), st.floats(-1, 2), st.integers(-5, 1 << 70), st.text(max_size=100))
def test_whatever_is_believed_can_be_told(loss: float, confidence: float, queue_ns: int, band: str) -> None:
    odd = LinkState(1 << 60, band, None, 0, 0, loss, True, queue_ns, confidence)
    append_estimate(bytearray(), EstimateExchange().take(odd, 0))


def test_the_trace_has_both_directions() -> None:
    exchange = EstimateExchange()
    exchange.on_frame(EstimateFrame(95_000, 48, 0.2, 1.0, False, "thin"), 7)
    both = LinkState(950_000, "fast", 1, 0, 0, 0.0, False, receiving=exchange.theirs)
    assert event_record(both, 9)["receiving"] == {
        "rate_bps": 95_000,
        "band": "thin",
        "loss_ratio": 0.2,
        "holding": False,
        "queue_ns": 48_000_000,
        "confidence": 1.0,
    }
    assert event_record(state(), 9)["receiving"] is None

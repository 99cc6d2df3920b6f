"""What is left of a queue is told by the datagrams of a new band, whatever its rate and delay."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from shaper.estimation.flights import Flights
from shaper.estimation.new_band import NewBand
from shaper.path import ReportedPacket

MS, NS_PER_S = 1_000_000, 1_000_000_000
BITS = 9808
CLOCK_NS = 77_000_000_000  # the peer's clock is ahead by this
MARGIN_NS = 10 * MS


def cross(
    flights: Flights, sent_ns: int, empty_ns: int, last_ns: int, rate_bps: float, delay_ms: float
) -> tuple[int, int]:
    """Send one through a link that keeps the order: when it is served, and when it arrives."""
    number = len(flights.acked) + len(flights.unreported)
    served_ns = max(sent_ns, empty_ns) + int(BITS * NS_PER_S / rate_bps)
    arrives_ns = max(last_ns, served_ns + int(delay_ms * MS))
    flights.on_sent(number, BITS, 0, sent_ns)
    return served_ns, arrives_ns


def report(number: int, arrived_ns: int) -> ReportedPacket:
    return ReportedPacket(number, 0, BITS // 8, arrived_ns // 1000 % (1 << 32))


@given(
    old_bps=st.floats(300e3, 3e6),
    fall=st.floats(3, 20),
    old_delay_ms=st.floats(10, 600),
    new_delay_ms=st.floats(10, 600),
    guess=st.floats(0.97, 1.03),
)
def test_the_queue_left_is_known_to_a_tenth_once_half_of_it_is_reported(
    old_bps: float, fall: float, old_delay_ms: float, new_delay_ms: float, guess: float
) -> None:
    new_bps = old_bps / fall
    flights, arrivals = Flights(), []
    empty_ns = last_ns = 0
    interval_ns = int(BITS * NS_PER_S / old_bps)
    for index in range(80):  # 20 in the old band, 60 before the sender knows of the new one
        rate_bps, delay_ms = (old_bps, old_delay_ms) if index < 20 else (new_bps, new_delay_ms)
        empty_ns, last_ns = cross(flights, index * interval_ns, empty_ns, last_ns, rate_bps, delay_ms)
        arrivals.append(last_ns)
    told = NewBand()
    reported = [report(n, arrivals[n] + CLOCK_NS) for n in range(55)]
    arrived = flights.on_report(reported)
    base_ns = arrived[0].delay_ns(old_bps)
    told.on_arrived(arrived, 15 * interval_ns, old_bps, base_ns, MARGIN_NS)
    now_ns = max(arrivals[54], 80 * interval_ns)
    left_ns = told.queue_ns(flights, guess * new_bps, now_ns)
    true_ns = max(0, empty_ns - now_ns)
    whole_ns = 60 * (int(BITS * NS_PER_S / new_bps) - interval_ns)
    assert abs(left_ns - true_ns) < 0.1 * whole_ns + 2 * BITS * NS_PER_S / new_bps


def test_without_news_of_the_new_band_nothing_is_taken_to_be_left_but_what_has_just_gone() -> None:
    flights = Flights()
    flights.on_sent(0, BITS, 0, 0)
    flights.on_report([report(0, 100_000)])
    flights.on_sent(1, BITS, 0, 50 * MS)
    assert NewBand().queue_ns(flights, 100_000, 50 * MS) == BITS * 10_000

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shaper.pacer import Pacer

S = 1_000_000_000


@given(
    rate_bps=st.integers(1, 20_000_000),
    credit_bytes=st.integers(0, 5_000),
    gaps_ns=st.lists(st.integers(0, 200_000_000), min_size=1, max_size=60),
    size_bytes=st.integers(29, 1500),
)
def test_no_interval_carries_more_than_rate_and_credit_and_one_datagram(
    rate_bps: int, credit_bytes: int, gaps_ns: list[int], size_bytes: int
) -> None:
    pacer = Pacer(rate_bps, credit_bytes)
    now_ns = 0
    departures: list[int] = []
    for gap_ns in gaps_ns:
        now_ns += gap_ns
        for _ in range(5):
            if not pacer.may_send(now_ns):
                break
            pacer.on_sent(size_bytes, now_ns)
            departures.append(now_ns)
    for first, start_ns in enumerate(departures):
        for last in range(first, len(departures)):
            bits = (last - first + 1) * size_bytes * 8
            allowed = rate_bps * (departures[last] - start_ns) + 8 * (credit_bytes + size_bytes) * S
            assert bits * S <= allowed


@given(
    rate_bps=st.integers(1, 20_000_000),
    credit_bytes=st.integers(0, 2000),
    sizes=st.lists(st.integers(1, 1500), min_size=1, max_size=10),
    now_ns=st.integers(0, 10 * S),
)
def test_the_next_send_time_is_the_first_moment_that_allows_one(
    rate_bps: int, credit_bytes: int, sizes: list[int], now_ns: int
) -> None:
    pacer = Pacer(rate_bps, credit_bytes, now_ns)
    for size_bytes in sizes:
        pacer.on_sent(size_bytes, now_ns)
    next_ns = pacer.next_send_at_ns(now_ns)
    if pacer.may_send(now_ns):
        assert next_ns == now_ns
        return
    assert next_ns > now_ns
    assert not pacer.may_send(next_ns - 1)
    assert pacer.may_send(next_ns)


def test_the_wait_rounds_up() -> None:
    pacer = Pacer(rate_bps=3, credit_bytes=0)
    pacer.on_sent(1, 0)
    assert pacer.next_send_at_ns(0) == 2_666_666_667  # 8 bits at 3 bit/s


def test_an_idle_sender_saves_up_no_more_than_its_credit() -> None:
    pacer = Pacer(rate_bps=8_000, credit_bytes=100)
    sent_bytes = 0
    while pacer.may_send(3600 * S):
        pacer.on_sent(10, 3600 * S)
        sent_bytes += 10
    assert sent_bytes == 110


def test_a_debt_is_paid_off_at_the_new_rate() -> None:
    pacer = Pacer(rate_bps=1_000_000, credit_bytes=0)
    pacer.on_sent(1000, 0)
    pacer.set_rate(8_000, 0, now_ns=4_000_000)  # half of the 8000 bits are paid
    assert pacer.next_send_at_ns(4_000_000) == 4_000_000 + S // 2


def test_spare_credit_is_cut_when_the_rate_drops() -> None:
    pacer = Pacer(rate_bps=1_000_000, credit_bytes=1250)
    pacer.set_rate(8_000, 10, now_ns=0)
    pacer.on_sent(11, 0)
    assert not pacer.may_send(0)


@pytest.mark.parametrize("rate_bps", [1, 95_000, 950_000, 10_000_000_000])
def test_the_long_run_rate_is_met_but_for_the_rounding_of_waits(rate_bps: int) -> None:
    pacer = Pacer(rate_bps, credit_bytes=0)
    now_ns, datagrams = 0, 1000
    for _ in range(datagrams):
        now_ns = pacer.next_send_at_ns(now_ns)
        pacer.on_sent(1228, now_ns)
    ideal_ns = -(-(datagrams - 1) * 1228 * 8 * S // rate_bps)
    assert ideal_ns <= now_ns <= ideal_ns + datagrams

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shaper.link_estimator import PresetBand, PresetBands, datagram_wire_bytes
from shaper.path import ReportedPacket

MS = 1_000_000
S = 1_000_000_000
FAST = PresetBand("fast", 1_000_000, 50 * MS)
THIN = PresetBand("thin", 100_000, 500 * MS)
SETTLED = (ReportedPacket(0, 0, 1000, 0),)


def report(estimator: PresetBands, rtt_ns: int, now_ns: int) -> None:
    estimator.on_report(SETTLED, rtt_ns, 0.0, now_ns)


def test_the_thinnest_band_is_assumed_until_the_link_has_shown_better() -> None:
    estimator = PresetBands([FAST, THIN])
    assert (estimator.band, estimator.rate_bps) == ("thin", 95_000)
    report(estimator, 110 * MS, now_ns=0)
    assert (estimator.band, estimator.rate_bps) == ("fast", 950_000)


@pytest.mark.parametrize(
    ("rtt_ms", "band"), [(0, "fast"), (100, "fast"), (540, "fast"), (560, "thin"), (9000, "thin")]
)
def test_the_band_with_the_nearest_delay_is_taken(rtt_ms: int, band: str) -> None:
    estimator = PresetBands([THIN, FAST])
    report(estimator, rtt_ms * MS, now_ns=0)
    assert estimator.band == band


def test_of_bands_with_the_same_delay_the_slowest_is_taken() -> None:
    bands = [PresetBand("quick", 5_000_000, 50 * MS), FAST, PresetBand("middle", 2_000_000, 50 * MS)]
    estimator = PresetBands(bands)
    report(estimator, 100 * MS, now_ns=0)
    assert estimator.band == "fast"


def test_a_single_late_round_trip_changes_no_band() -> None:
    estimator = PresetBands([FAST, THIN])
    report(estimator, 100 * MS, now_ns=0)
    report(estimator, 1000 * MS, now_ns=150 * MS)
    assert estimator.band == "fast"
    report(estimator, 1000 * MS, now_ns=201 * MS)
    assert estimator.band == "thin"


def test_round_trips_to_a_former_peer_are_forgotten() -> None:
    estimator = PresetBands([FAST, THIN])
    report(estimator, 100 * MS, now_ns=0)
    estimator.on_peer_restarted(1 * MS)
    report(estimator, 1000 * MS, now_ns=2 * MS)
    assert estimator.band == "thin"


def test_a_report_without_news_changes_nothing() -> None:
    estimator = PresetBands([FAST, THIN])
    estimator.on_report((), 100 * MS, 0.5, 0)
    estimator.on_report(SETTLED, None, 0.5, 0)
    assert (estimator.band, estimator.loss_ratio) == ("thin", 0.5)


@pytest.mark.parametrize("band", [FAST, THIN])
def test_what_may_be_in_flight_fills_the_link_and_little_more(band: PresetBand) -> None:
    estimator = PresetBands([band])
    pipe_bytes = estimator.rate_bps * 2 * band.one_way_delay_ns // (8 * S)
    excess_ns = (estimator.in_flight_limit_bytes - pipe_bytes) * 8 * S // band.rate_bps
    assert 100 * MS < excess_ns < 350 * MS


@given(st.integers(1, 10_000_000_000), st.integers(328, 1500))
def test_a_full_datagram_takes_no_more_than_50_ms_of_any_but_the_thinnest_link(
    rate_bps: int, most: int
) -> None:
    size = datagram_wire_bytes(rate_bps, most)
    assert 300 <= size <= most
    assert size == 300 or size * 8 * S <= rate_bps * 50 * MS


@given(
    st.lists(st.tuples(st.integers(1000, 10**10), st.integers(0, 60 * S)), min_size=1, max_size=6),
    st.integers(0, 120 * S),
)
def test_the_estimate_is_always_one_of_the_presets(bands: list[tuple[int, int]], rtt_ns: int) -> None:
    estimator = PresetBands([PresetBand(str(i), *band) for i, band in enumerate(bands)], pace_ratio=1.0)
    report(estimator, rtt_ns, 0)
    rate_bps, delay_ns = bands[int(estimator.band)]
    assert estimator.rate_bps == rate_bps
    nearest_ns = min(abs(d - rtt_ns // 2) for _, d in bands)
    assert abs(delay_ns - rtt_ns // 2) == nearest_ns

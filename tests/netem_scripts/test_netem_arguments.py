"""The words for tc, and what is made of its answer."""

from __future__ import annotations

import json
import statistics
from typing import Any

import pytest

from netem_scripts.band import Band, BurstLoss, DirectionProfile, JitterShape, ProfileError
from netem_scripts.netem_arguments import half_normal_table, netem_band
from netem_scripts.profiles import profile_named
from netem_scripts.tc import Interface, NetemSchedule

S = 1_000_000_000
MS = 1_000_000

# As iproute2 6.1 prints it for the first band of the trials.
SHOWN: dict[str, Any] = json.loads(
    '{"limit":1022,"delay":{"delay":0.05,"jitter":0,"correlation":0},'
    '"rate":{"rate":125000,"packetoverhead":-14,"cellsize":0,"celloverhead":0},"ecn":false,"gap":0}'
)


def words(band: Band, **direction: Any) -> str:
    return " ".join(netem_band(DirectionProfile((band,), **direction), 0, 1228).arguments())


def test_rates_are_bits_and_the_ethernet_header_is_not_charged() -> None:
    text = words(Band(S, 1_000_000, 50 * MS), buffer_ns=10 * S)
    assert text == ("limit 1022 delay 50000.000us loss random 0% duplicate 0% corrupt 0% rate 1000000bit -14")


def test_the_limit_counts_the_buffer_and_what_is_in_the_delay_line() -> None:
    assert words(Band(S, 982_400, 0), buffer_ns=S).startswith("limit 100 ")
    assert words(Band(S, 982_400, 500 * MS), buffer_ns=S).startswith("limit 150 ")
    assert words(Band(S, 982_400, 500 * MS), buffer_bytes=12_280, buffer_ns=S).startswith("limit 60 ")
    assert words(Band(S, 982_400, 500 * MS), buffer_packets=7).startswith("limit 57 ")


def test_a_profile_that_charges_more_than_ip_says_so_to_the_kernel() -> None:
    assert words(Band(S, 9_600, 0), overhead_bytes=42).endswith("rate 9600bit 0")


def test_loss_in_bursts_is_the_kernel_s_gilbert_elliott() -> None:
    band = Band(S, 9_600, 0, burst_loss=BurstLoss(0.0005, 0.1, 0.75, 0.001))
    assert "loss gemodel 0.05% 10% 75% 0.1% " in words(band)


def test_uniform_jitter_is_moved_to_the_kernel_s_middle() -> None:
    band = Band(S, 9_600, 50 * MS, jitter_ns=10 * MS, jitter_shape=JitterShape.UNIFORM)
    assert "delay 55000.000us 5000.000us loss" in words(band)


def test_half_normal_jitter_has_a_table_of_its_own() -> None:
    band = Band(S, 9_600, 50 * MS, jitter_ns=10 * MS)
    assert "delay 50000.000us 10000.000us distribution straitlink-half-normal " in words(band)
    values = [int(v) / 8192 for line in half_normal_table().splitlines()[1:] for v in line.split()]
    assert len(values) == 4096 and min(values) >= 0
    assert statistics.mean(values) == pytest.approx(0.798, abs=0.001)  # sqrt(2 / pi)
    assert statistics.quantiles(values, n=20)[-1] == pytest.approx(1.960, abs=0.005)


@pytest.mark.parametrize(
    ("band", "direction", "complaint"),
    [
        (Band(S, 0, 0), {}, "Band 0 has rate_bps = 0; netem cannot hold"),
        (Band(S, 1000, 0, reorder=True), {}, "Band 0 has reorder = true"),
        (Band(S, 1000, 0), {"mtu_bytes": 576}, "mtu_bytes = 576"),
    ],
)
def test_what_netem_cannot_do_is_refused(band: Band, direction: dict[str, Any], complaint: str) -> None:
    with pytest.raises(ProfileError, match=complaint):
        netem_band(DirectionProfile((band, Band(S, 1000, 0)), **direction), 0, 1228)


def test_what_the_kernel_has_is_compared_with_what_was_asked() -> None:
    asked = netem_band(profile_named("trials").down, 0, 1228)
    assert asked.differences(SHOWN) == []
    wrong = {**SHOWN, "rate": {"rate": 1_000_000, "packetoverhead": -14}, "limit": 7}
    assert asked.differences(wrong) == [
        "limit = 1022 was asked for, the kernel has 7",
        "rate in byte/s = 125000 was asked for, the kernel has 1000000",
    ]
    assert asked.differences({**SHOWN, "loss-random": {"loss": 0.1, "correlation": 0}}) == [
        "loss = 0.0 was asked for, the kernel has 0.1"
    ]
    assert "rate in byte/s = 125000 was asked for, the kernel has None" in asked.differences({})


def test_the_printed_commands_are_one_cycle_and_the_removal() -> None:
    direction = profile_named("trials").down
    lines = list(NetemSchedule(direction, Interface("eth0"), 1228).script())
    assert [line for line in lines if line.startswith("#")] == [
        "# at 0 s",
        "# at 60 s",
        "# at 120 s from the top, with change",
        "# at the end",
    ]
    first, second, last = (line for line in lines if not line.startswith("#"))
    assert first.startswith("tc qdisc add dev eth0 root handle 71: netem limit 1022 ")
    assert second.startswith("tc qdisc change dev eth0 root handle 71: netem limit 106 ")
    assert last == "tc qdisc del dev eth0 root handle 71:"


def test_a_schedule_that_repeats_a_band_prints_each_occurrence() -> None:
    direction = profile_named("blackouts").down
    lines = list(NetemSchedule(direction, Interface("eth0"), 1228).script())
    assert len([line for line in lines if " netem " in line]) == len(direction.bands)

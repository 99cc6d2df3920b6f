"""Bursts of loss, flipped bits: figures that can be derived."""

from __future__ import annotations

import math
import random
from itertools import groupby

import pytest
from hypothesis import given
from hypothesis import strategies as st

from netem_scripts.band import Band, BurstLoss, DirectionProfile, ProfileError
from netem_scripts.chance import Chance, with_flipped_bit
from netem_scripts.link import Link

S = 1_000_000_000


def lost(burst: BurstLoss, count: int, seed: int) -> list[bool]:
    chance, band = Chance(random.Random(seed)), Band(S, 1, 0, burst_loss=burst)
    return [chance.loses(band) for _ in range(count)]


@pytest.mark.parametrize(
    ("burst", "mean_ratio"),
    [
        (BurstLoss(0.02, 0.25), 0.02 / 0.27),
        (BurstLoss(0.05, 0.20, bad_loss_ratio=0.5, good_loss_ratio=0.01), 0.2 * 0.5 + 0.8 * 0.01),
    ],
)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_burst_loss_has_its_mean(burst: BurstLoss, mean_ratio: float, seed: int) -> None:
    count = 100_000
    assert burst.mean_ratio == pytest.approx(mean_ratio)
    # The states are correlated over 1 / (p + r) packets, which widens the binomial error so much.
    correlated = 2 / (burst.enter_bad_ratio + burst.leave_bad_ratio)
    sigma = math.sqrt(mean_ratio * (1 - mean_ratio) * correlated / count)
    assert abs(sum(lost(burst, count, seed)) / count - mean_ratio) < 4 * sigma


def test_a_burst_lasts_the_inverse_of_the_chance_to_leave_it() -> None:
    runs = [len(list(run)) for dropped, run in groupby(lost(BurstLoss(0.02, 0.25), 200_000, 1)) if dropped]
    assert sum(runs) / len(runs) == pytest.approx(4.0, rel=0.05)


def test_a_burst_goes_on_over_a_change_of_band() -> None:
    burst = BurstLoss(1.0, 1e-9)  # bad from the second packet on, practically for ever
    bands = (Band(S, 10**6, 0, burst_loss=burst), Band(S, 10**6, 0), Band(S, 10**6, 0, burst_loss=burst))
    link = Link(DirectionProfile(bands), random.Random(1))
    fates = [link.transmit(100, at * S // 2).drop for at in range(6)]
    assert [fate is not None for fate in fates] == [False, True, False, False, True, True]


@given(st.binary(min_size=1), st.data())
def test_a_flipped_bit_is_one_bit_and_flips_back(payload: bytes, data: st.DataObject) -> None:
    bit = data.draw(st.integers(0, 8 * len(payload) - 1))
    flipped = with_flipped_bit(payload, bit)
    changed = int.from_bytes(payload, "big") ^ int.from_bytes(flipped, "big")
    assert changed == 1 << (8 * len(payload) - 1 - bit)
    assert with_flipped_bit(flipped, bit) == payload


def test_corruption_hits_its_share_evenly_over_the_payload() -> None:
    band = Band(S, 10**9, 0, corrupt_ratio=0.2)
    link = Link(DirectionProfile((band,)), random.Random(1))
    bits = [link.transmit(10, at).corrupted_bit for at in range(20_000)]
    hit = [bit for bit in bits if bit is not None]
    assert abs(len(hit) - 4000) < 4 * math.sqrt(20_000 * 0.2 * 0.8)
    assert set(hit) == set(range(80))
    assert all(link.transmit(0, 30_000 + at).corrupted_bit is None for at in range(100))


@pytest.mark.parametrize(
    ("values", "complaint"),
    [
        ({"enter_bad_ratio": 0.0, "leave_bad_ratio": 0.5}, "enter_bad_ratio = 0.0 must be above 0"),
        (
            {"enter_bad_ratio": 0.1, "leave_bad_ratio": 1.5},
            "leave_bad_ratio = 1.5 must be above 0 and at most 1",
        ),
        (
            {"enter_bad_ratio": 0.1, "leave_bad_ratio": 0.5, "bad_loss_ratio": -1.0},
            "bad_loss_ratio = -1.0 must be between 0 and 1",
        ),
    ],
)
def test_a_burst_loss_that_makes_no_sense_is_refused(values: dict[str, float], complaint: str) -> None:
    with pytest.raises(ProfileError, match=complaint):
        BurstLoss(**values)


def test_two_kinds_of_loss_in_a_band_are_refused() -> None:
    with pytest.raises(ProfileError, match=r"loss_ratio = 0\.1 must be 0 where it has a burst_loss"):
        Band(S, 1, 0, loss_ratio=0.1, burst_loss=BurstLoss(0.1, 0.5))

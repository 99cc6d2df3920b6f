from __future__ import annotations

import itertools
import math
import random
import statistics
import tomllib
from pathlib import Path

import pytest

from netem_scripts.band import Band, BurstLoss, DirectionProfile, JitterShape, Order, Profile, ProfileError
from netem_scripts.finals import blackouts_s
from netem_scripts.link import DropReason, Link
from netem_scripts.profile_file import profile_from_dict, profile_to_dict, read_profile
from netem_scripts.profiles import load_profile, named_profiles, profile_named

S = 1_000_000_000
MS = 1_000_000
ROOT = Path(__file__).resolve().parents[2]
BAND = "duration_s = 2.5\nrate_bps = 64000\none_way_delay_ms = 12.5\n"


def written(folder: Path, text: str) -> Path:
    path = folder / "link.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_the_trials_alternate_both_directions_each_minute_behind_10_s_of_buffer() -> None:
    profile = profile_named("trials")
    bands = (Band(60 * S, 1_000_000, 50 * MS), Band(60 * S, 100_000, 500 * MS))
    assert profile.down == profile.up == DirectionProfile(bands, cyclic=True, buffer_ns=10 * S)


def test_the_swapped_trials_have_the_same_rates_and_the_other_delays() -> None:
    bands = profile_named("trials-swapped").down.bands
    assert [(b.rate_bps, b.one_way_delay_ns) for b in bands] == [(1_000_000, 500 * MS), (100_000, 50 * MS)]


@pytest.mark.parametrize(
    ("name", "rate_bps", "delay_ns"),
    [
        ("constant-100k-500ms", 100_000, 500 * MS),
        ("constant-1m-50ms", 1_000_000, 50 * MS),
        ("constant-9600-0ms", 9_600, 0),
        ("constant-1.5m-2.5ms", 1_500_000, 2_500_000),
    ],
)
def test_a_constant_profile_is_read_from_its_name(name: str, rate_bps: int, delay_ns: int) -> None:
    profile = profile_named(name)
    assert profile.name == name
    (band,) = profile.down.bands
    assert (band.rate_bps, band.one_way_delay_ns) == (rate_bps, delay_ns)


@pytest.mark.parametrize("name", ["trails", "constant", "constant-100k", "constant--1k-5ms", ""])
def test_an_unknown_name_is_answered_with_what_exists(name: str) -> None:
    with pytest.raises(
        ProfileError, match=f'no link profile "{name}"; there are trials, trials-swapped, .*, constant-'
    ):
        profile_named(name)


def test_a_constant_profile_of_no_rate_is_refused() -> None:
    with pytest.raises(ProfileError, match="rate_bps = 0 in the last band would hold its queue for ever"):
        profile_named("constant-0-50ms")


def test_bands_at_the_top_apply_to_both_directions(tmp_path: Path) -> None:
    profile = load_profile(written(tmp_path, f"buffer_s = 0.1\n[[band]]\n{BAND}"))
    assert profile.name == "link"
    assert profile.down == profile.up
    assert profile.down == DirectionProfile((Band(2_500 * MS, 64_000, 12_500_000),), buffer_ns=100 * MS)


def test_a_direction_replaces_what_it_says_itself(tmp_path: Path) -> None:
    text = f"cyclic = true\nbuffer_bytes = 5000\n[up]\nbuffer_bytes = 900\n[[up.band]]\n{BAND}[[down.band]]\n{BAND}jitter_ms = 3\njitter_shape = 'uniform'\n"
    profile = read_profile(written(tmp_path, text))
    assert (profile.down.buffer_bytes, profile.up.buffer_bytes) == (5000, 900)
    assert profile.down.cyclic and profile.up.cyclic
    assert profile.down.bands[0].jitter_ns == 3 * MS
    assert profile.down.bands[0].jitter_shape is JitterShape.UNIFORM
    assert profile.up.bands[0].jitter_ns == 0


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (f"[[band]]\n{BAND}lossratio = 0.1\n", r"band\.0\.lossratio = 0\.1: extra inputs are not permitted"),
        (f"[[band]]\n{BAND}loss_ratio = 1.5\n", r"band\.0\.loss_ratio = 1\.5: .* less than or equal to 1"),
        (f"[[band]]\n{BAND}jitter_ms = inf\n", r"band\.0\.jitter_ms = inf: "),
        (f"[[band]]\n{BAND}jitter_ms = nan\n", r"band\.0\.jitter_ms = nan: "),
        (
            "[[band]]\nduration_s = 1\nrate_bps = '1M'\none_way_delay_ms = 1\n",
            r"band\.0\.rate_bps = '1M': .*integer",
        ),
        ("[[band]]\nduration_s = 1\nrate_bps = 1000\n", r"band\.0\.one_way_delay_ms: field required"),
        ("[[band]]\nduration_s = 1\nrate_bps = 0\none_way_delay_ms = 1\n", "rate_bps = 0 in the last band"),
        (f"[[down.band]]\n{BAND}", r"up\.band has no entry"),
        (f"[[band]]\n{BAND}[[down.band]]\n{BAND}[[up.band]]\n{BAND}", "band is never used"),
        ("buffer_s = 0\n", "buffer_s = 0: .*greater than 0"),
        ("[[band]\n", "is not TOML"),
    ],
)
def test_a_mistake_in_a_file_is_named_with_file_field_value_and_bound(
    tmp_path: Path, text: str, complaint: str
) -> None:
    with pytest.raises(ProfileError, match=rf"link\.toml: .*{complaint}"):
        read_profile(written(tmp_path, text))


def test_a_missing_file_is_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(ProfileError, match=r"none\.toml: the link profile cannot be read: No such file"):
        load_profile(str(tmp_path / "none.toml"))


@pytest.mark.parametrize("profile", named_profiles(), ids=lambda profile: profile.name)
def test_every_named_profile_knows_its_name_its_source_and_reads_back_the_same(profile: Profile) -> None:
    assert profile_named(profile.name) == profile
    assert profile.description and profile.source
    assert profile_from_dict(profile_to_dict(profile), where="saved", name="other") == profile


def test_the_csv_example_in_the_documentation_is_a_profile(tmp_path: Path) -> None:
    document = (ROOT / "docs" / "link.md").read_text(encoding="utf-8")
    path = tmp_path / "example.csv"
    path.write_text(document.split("```csv\n")[1].split("```")[0])
    profile = load_profile(path)
    assert [band.rate_bps for band in profile.down.bands] == [1_000_000, 64_000]
    assert [band.rate_bps for band in profile.up.bands] == [1_000_000, 9_600]


def test_every_named_profile_is_in_the_documentation() -> None:
    document = (ROOT / "docs" / "link.md").read_text(encoding="utf-8")
    assert [p.name for p in named_profiles() if f"`{p.name}`" not in document] == []


def test_the_example_in_the_documentation_is_a_profile() -> None:
    document = (ROOT / "docs" / "link.md").read_text(encoding="utf-8")
    example = document.split("```toml\n")[1].split("```")[0]
    profile = profile_from_dict(tomllib.loads(example), where="docs/link.md", name="example")
    assert [band.rate_bps for band in profile.down.bands] == [1_000_000, 0, 200_000]
    assert profile.up.bands[0].loss_ratio == 0.02
    assert (profile.down.buffer_ns, profile.up.buffer_bytes) == (10 * S, 5_000)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"duration_ns": 0}, "duration_ns = 0 must be greater than 0"),
        ({"rate_bps": -1}, "rate_bps = -1 must be at least 0"),
        ({"loss_ratio": 1.01}, "loss_ratio = 1.01 must be between 0 and 1"),
        ({"duplicate_ratio": float("nan")}, "duplicate_ratio = nan must be between 0 and 1"),
    ],
)
def test_a_band_that_makes_no_sense_is_refused(change: dict[str, float], complaint: str) -> None:
    values: dict[str, float] = {"duration_ns": S, "rate_bps": 1, "one_way_delay_ns": 1, **change}
    with pytest.raises(ProfileError, match=complaint):
        Band(**values)  # type: ignore[arg-type]


def test_a_cycle_that_never_serves_is_refused() -> None:
    with pytest.raises(ProfileError, match="rate_bps = 0 in every band"):
        DirectionProfile((Band(S, 0, 0), Band(S, 0, 0)), cyclic=True)


def test_a_constant_profile_takes_loss_jitter_and_buffer_from_its_name() -> None:
    profile = profile_named("constant-1m-50ms-loss2.5-jitter10ms-buffer100ms")
    (band,) = profile.down.bands
    assert (band.loss_ratio, band.jitter_ns, profile.down.buffer_ns) == (0.025, 10 * MS, 100 * MS)


def test_the_finals_have_the_blackouts_of_the_example_schedule() -> None:
    for seed in (1, 2):
        lengths_s = blackouts_s(seed)
        assert len(lengths_s) == 370 and min(lengths_s) == 1 and max(lengths_s) == 30
        assert lengths_s.count(30) == 7
        assert statistics.median(lengths_s) == 4
        assert statistics.mean(lengths_s) == pytest.approx(6.4, abs=0.05)
        assert sum(lengths_s) + 370 == pytest.approx(45 * 60 + 37, abs=3)
    assert blackouts_s(1) != blackouts_s(2) and sorted(blackouts_s(1)) == sorted(blackouts_s(2))
    assert profile_named("finals-1") == profile_named("finals") != profile_named("finals-2")


def test_the_finals_fast_link_has_the_same_windows_and_nothing_comes_back() -> None:
    profile = profile_named("finals-fast")
    assert profile_named("finals-fast-1") == profile != profile_named("finals-fast-2")
    open_s, whole_s = [], 0.0
    for band in profile.down.bands:
        open_s += [whole_s] if band.loss_ratio == 0 else []
        whole_s += band.duration_ns / 1e9
    assert len(open_s) == 371 and open_s[1] == 1 + blackouts_s(1)[0]
    back = Link(profile.up, random.Random(1))
    assert all(not back.transmit(100, t * 10**9).arrivals_ns for t in range(100))


def test_the_finals_lose_the_fast_queue_in_the_dark_and_hold_5000_bytes_while_slow() -> None:
    link = Link(profile_named("finals").down, random.Random(1))
    drops = [link.transmit(1458, S - 1).drop for _ in range(300)]
    assert drops.count(None) <= 1 and drops.count(DropReason.LOSS) >= 255
    assert drops.count(DropReason.OVERFLOW) == 300 - 256
    slow = [link.transmit(1458, S + 500 * MS).drop for _ in range(10)]
    assert slow == [None] * 3 + [DropReason.OVERFLOW] * 7
    assert link.band_at(S + 500 * MS).rate_bps == 9_600


def test_the_walk_changes_by_an_order_of_magnitude_but_not_at_once() -> None:
    rates_bps = [band.rate_bps for band in profile_named("lte-walk").down.bands]
    assert max(rates_bps) > 10 * min(rates_bps)
    assert all(abs(math.log(b / a)) < math.log(1.62) for a, b in itertools.pairwise(rates_bps))


def test_every_field_of_a_file_reaches_the_profile(tmp_path: Path) -> None:
    text = f"buffer_packets = 7\nminimum_bytes = 74\nmtu_bytes = 1500\norder = 'delay-then-rate'\n[[band]]\n{BAND}corrupt_ratio = 0.1\n[band.burst_loss]\nenter_bad_ratio = 0.1\nleave_bad_ratio = 0.5\n"
    profile = read_profile(written(tmp_path, text))
    band = Band(2_500 * MS, 64_000, 12_500_000, corrupt_ratio=0.1, burst_loss=BurstLoss(0.1, 0.5))
    order = Order.DELAY_THEN_RATE
    assert profile.up == DirectionProfile(
        (band,), buffer_packets=7, minimum_bytes=74, mtu_bytes=1500, order=order
    )
    assert profile_from_dict(profile_to_dict(profile), where="saved", name="other") == profile


def test_a_csv_file_is_a_band_per_row(tmp_path: Path) -> None:
    path = tmp_path / "walk.csv"
    path.write_text(
        "# buffer_s = 2\n# cyclic = true\ndirection,duration_s,rate_bps,one_way_delay_ms,loss_ratio,reorder\n"
        "both,1,1000000,50,,\ndown,2.5,64_000,12.5,0.1,TRUE\n\nup,1,9600,50,,false\n"
    )
    profile = load_profile(str(path))
    both = Band(S, 1_000_000, 50 * MS)
    down = Band(2_500 * MS, 64_000, 12_500_000, loss_ratio=0.1, reorder=True)
    assert profile.name == "walk"
    assert profile.down == DirectionProfile((both, down), cyclic=True, buffer_ns=2 * S)
    assert profile.up.bands == (both, Band(S, 9_600, 50 * MS))


def test_a_csv_file_without_directions_is_for_both(tmp_path: Path) -> None:
    path = tmp_path / "both.csv"
    path.write_text("duration_s,rate_bps,one_way_delay_ms\n1,1000,5\n")
    profile = load_profile(path)
    assert profile.down == profile.up == DirectionProfile((Band(S, 1000, 5 * MS),))


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("duration_s,rate_bps\n1,1000\n", r"down\.band\.0\.one_way_delay_ms: field required"),
        ("duration_s,rate_bps,one_way_delay_ms\n1,fast,5\n", r"down\.band\.0\.rate_bps = 'fast'"),
        ("duration_s,rate_bps,one_way_delay_ms\n1,1000,5,7\n", "row 1: it has more cells"),
        ("direction,duration_s\nleft,1\n", "row 1: direction = left must be one of down, up, both"),
        ("duration_s,rate_bps,one_way_delay_ms\n", r"down\.band has no entry"),
        ("# buffer_s 10\nduration_s\n", "the lines that begin with # are not TOML"),
    ],
)
def test_a_mistake_in_a_csv_file_is_named(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "link.csv"
    path.write_text(text)
    with pytest.raises(ProfileError, match=rf"link\.csv: {complaint}"):
        load_profile(path)

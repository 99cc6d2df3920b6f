from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree

import pytest

from netem_scripts.band import Profile
from netem_scripts.picture import picture
from netem_scripts.profiles import named_profiles, profile_named

SVG = "{http://www.w3.org/2000/svg}"


def lines(profile: Profile) -> list[list[tuple[float, float]]]:
    """The step lines in their order: rate down, rate up, delay down, delay up."""
    found = []
    for line in ElementTree.fromstring(picture(profile)).iter(f"{SVG}polyline"):
        points = [point.split(",") for point in line.attrib["points"].split()]
        found.append([(float(x), float(y)) for x, y in points])
    return found


@pytest.mark.parametrize("profile", named_profiles(), ids=lambda profile: profile.name)
def test_every_profile_has_a_picture_whose_lines_stay_inside(profile: Profile) -> None:
    drawn = lines(profile)
    assert len(drawn) == 4
    assert all(70 <= x <= 880 and 50 <= y <= 500 for line in drawn for x, y in line)
    assert all(line == sorted(line, key=lambda point: point[0]) for line in drawn)


def test_the_trials_step_down_in_rate_and_up_in_delay_after_a_minute() -> None:
    rate, _, delay, _ = lines(profile_named("trials"))
    assert [x for x, _ in rate] == [70.0, 475.0, 475.0, 880.0]
    assert rate[0][1] < rate[-1][1] and delay[0][1] > delay[-1][1]  # down the page is less


def test_names_are_escaped() -> None:
    profile = profile_named("trials")
    hostile = Profile("<script>&", profile.down, profile.up)
    assert re.search("&lt;script&gt;&amp;", picture(hostile))

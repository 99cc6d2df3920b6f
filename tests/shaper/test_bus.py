"""What the bus decides without a network: which subscriptions are needed, and refusals."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shaper.bus import BusError, BusSettings, _without_covered, open_bus
from shaper.key_expression import matches


def test_an_expression_that_another_covers_needs_no_subscriber() -> None:
    assert _without_covered(["robot/a", "robot/**", "robot/*", "robot/a"]) == ["robot/**"]
    assert _without_covered(["robot/*/image", "robot/camera/*"]) == ["robot/*/image", "robot/camera/*"]


@given(
    st.lists(st.sampled_from(["a", "b", "a/*", "a/**", "**", "*/b", "a/b", "a$*", "@a/**"]), max_size=6),
    st.lists(st.sampled_from(["a", "b", "@a", "ab"]), min_size=1, max_size=3).map("/".join),
)
def test_dropping_covered_expressions_loses_no_key(expressions: list[str], key: str) -> None:
    before = any(matches(e, key) for e in expressions)
    assert any(matches(e, key) for e in _without_covered(expressions)) == before


def test_an_unknown_zenoh_option_is_told_by_name_and_value() -> None:
    settings = BusSettings(options={"transport/no/such/option": 5})
    with pytest.raises(BusError, match="zenoh option transport/no/such/option = 5 is refused"):
        open_bus(settings)


def test_an_endpoint_that_cannot_be_is_told() -> None:
    with pytest.raises(BusError, match=r"cannot open the Zenoh bus|is refused"):
        open_bus(BusSettings(listen=["tcp/127.0.0.1:not-a-port"]))

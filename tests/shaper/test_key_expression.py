"""Our matching against Zenoh's own: what the shaper forwards is what the bus would match."""

import pytest
import zenoh
from hypothesis import example, given, settings
from hypothesis import strategies as st

from shaper.key_expression import check_key_expression, is_key, matches
from shaper.traffic_class import DEFAULT_CLASSES, TopicRule, first_match

_PIECES = st.sampled_from(["a", "b", "ab", "$*", "*", "**", "@", "@a", "$", "é", ".", "+", "(", " "])
_CHUNKS = st.one_of(
    st.sampled_from(["a", "b", "*", "**", "a$*", "$*b", "a$*b", "@a", "ab", "aab", "@$*", "$*@"]),
    st.lists(_PIECES, min_size=1, max_size=3).map("".join),
)
_EXPRESSIONS = st.lists(_CHUNKS, min_size=1, max_size=5).map("/".join)
_KEYS = st.lists(
    st.sampled_from(["a", "b", "ab", "aab", "acb", "@a", "@", "é", "a.b", "b@"]), min_size=1, max_size=5
).map("/".join)


def accepted_by_zenoh(text: str) -> bool:
    try:
        zenoh.KeyExpr(text)
    except zenoh.ZError:
        return False
    return True


@settings(max_examples=400)
@given(_EXPRESSIONS, _KEYS)
@example("a/**", "a")
@example("**", "@a")
@example("@$*", "@a")
@example("a/**/@b", "a/@b")
@example("a$*", "a")
def test_a_key_matches_exactly_when_zenoh_says_so(expression: str, key: str) -> None:
    if accepted_by_zenoh(expression):
        assert matches(expression, key) == zenoh.KeyExpr(expression).intersects(zenoh.KeyExpr(key))


@settings(max_examples=400)
@given(st.one_of(_EXPRESSIONS, st.text(alphabet="ab@$*/?# é", max_size=8)))
@example("$*")
@example("a$*$*")
@example("**/**")
@example("a/**/*")
@example("/a")
@example("a//b")
@example("")
def test_an_expression_is_accepted_exactly_when_zenoh_accepts_it(text: str) -> None:
    assert (check_key_expression(text) is None) == accepted_by_zenoh(text)


@given(st.text(max_size=12))
@example("a\x00b")
@example("a\nb")
def test_what_a_peer_names_as_a_key_is_a_key_for_zenoh_too(text: str) -> None:
    assert is_key(text) == (accepted_by_zenoh(text) and "*" not in text)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "not empty"),
        ("/a", "slash"),
        ("a?", "no ?"),
        ("a/b*", "wildcard"),
        ("a$", "$ stands only"),
        ("a/$*", "whole chunk"),
        ("**/*", "followed"),
    ],
)
def test_what_is_wrong_with_an_expression_is_said(text: str, reason: str) -> None:
    assert reason in (check_key_expression(text) or "")


def test_the_first_rule_that_matches_decides() -> None:
    narrow = TopicRule("robot/joints", DEFAULT_CLASSES["state"])
    wide = TopicRule("robot/**", DEFAULT_CLASSES["bulk"])
    assert first_match((narrow, wide), "robot/joints") is narrow
    assert first_match((wide, narrow), "robot/joints") is wide
    assert first_match((narrow, wide), "operator/joints") is None

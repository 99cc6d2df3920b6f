"""What the page of benchmarks says of other stacks, and that it leaves nothing out."""

from __future__ import annotations

from bench.__main__ import COMPUTING, LIVE
from bench.page.markdown import markdown_page
from bench.page.sections import SECTIONS
from bench.page.standing import behind
from bench.peers.summary import Row, summarise
from bench.trials_rule import CHANNELS, LOAD
from straitlink.mission import load_named_or_file

WINDOW = "thin"


def run(peer: str, heartbeat_p95_ms: float | None, images: int, seed: int = 1) -> dict[str, object]:
    """One run of one stack in one band, as bench.peers leaves it."""
    figures = {
        "offered": 100,
        "delivered": 100,
        "in_window": images,
        "age_p50_ms": heartbeat_p95_ms,
        "age_p95_ms": heartbeat_p95_ms,
        "age_max_ms": heartbeat_p95_ms,
    }
    topics = ("robot/heartbeat", "robot/joints", "robot/image", "operator/command")
    window = {"name": WINDOW, "topics": dict.fromkeys(topics, figures), "link": None}
    return {"load": "camera-flood", "profile": "trials", "peer": peer, "seed": seed, "windows": [window]}


def rows(*runs: dict[str, object]) -> list[Row]:
    return summarise(runs)


def test_a_stack_with_more_images_or_younger_heartbeats_is_named_with_both_figures() -> None:
    found = list(behind(rows(run("straitlink", 600, 9), run("zenoh-tcp", 500, 13))))
    (images,) = [b for b in found if b.figure == "images in time"]
    assert (images.ours, images.theirs, images.peer) == ("9", "13", "zenoh-tcp")
    assert {b.figure for b in found} >= {"heartbeat's age p50", "heartbeat's age p95", "commands' age p95"}


def test_a_stack_that_is_behind_level_or_delivers_nothing_is_not() -> None:
    ours = run("straitlink", 600, 9)
    assert not list(behind(rows(ours, run("tcp", 9000, 4))))
    assert not list(behind(rows(ours, run("tcp", 590, 9))))
    assert not list(behind(rows(ours, run("tcp", None, 0))))


def test_a_stack_is_ahead_of_one_that_delivers_nothing() -> None:
    assert list(behind(rows(run("straitlink", None, 0), run("tcp", 9000, 4))))


def test_every_bench_that_make_bench_runs_has_its_part_of_the_page() -> None:
    names = {command[0].removeprefix("bench.") for command in (*COMPUTING, *LIVE)}
    assert names <= set(SECTIONS)


def test_the_page_says_first_what_the_figures_are_and_where_another_stack_is_ahead() -> None:
    document = {"commit": "abc", "python": "3.11", "runs": [run("straitlink", 600, 9), run("tcp", 500, 9)]}
    text = markdown_page([SECTIONS["peers"](document)])
    assert text.index("thin, slow, changing and broken") < text.index("ahead of straitlink")
    assert text.index("ahead of straitlink") < text.index("over trials, band thin")
    assert "| camera-flood, trials, thin | heartbeat's age p95 | 600 ms | 500 ms | tcp |" in text


def test_the_channels_of_the_trials_carry_every_topic_of_their_load() -> None:
    assert set(CHANNELS) == {topic.key for topic in load_named_or_file(LOAD).topics}

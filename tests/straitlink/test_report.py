"""A run's figures, from traces written here line by line."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mcap.writer import Writer
from rich.console import Console

from netem_scripts.profiles import load_profile
from straitlink.mission import MissionSettings, load_named_or_file
from straitlink.mission.output import run_and_save
from straitlink.report import ReportError, print_table, read_run, summarise
from straitlink.report.age import sawtooth
from straitlink.report.figures import rate, seconds, size
from straitlink.report.run import Deliveries, Steps
from straitlink.report.summary import Spread, Summary, TopicSummary, spread

S = 1_000_000_000
MS = 1_000_000
UNIX_NS = 1_800_000_000 * S
ROBOT_NS, OPERATOR_NS, LINK_NS = 5 * S, 9_000 * S, 77 * S  # three clocks that know nothing of each other


class Trace:
    """One side's JSON lines; event() takes seconds since the start of the run."""

    def __init__(self, folder: Path, side: str, clock_ns: int) -> None:
        self.path = folder / f"{side}.jsonl"
        self.clock_ns = clock_ns
        self.line(event="start", t_ns=clock_ns, unix_ns=UNIX_NS, side=side)

    def line(self, **event: Any) -> None:
        with self.path.open("a") as stream:
            stream.write(json.dumps(event) + "\n")

    def event(self, name: str, t_s: float, **fields: Any) -> None:
        self.line(event=name, t_ns=self.clock_ns + round(t_s * S), **fields)

    def delivered(
        self, t_s: float, topic: str, age_s: float, delay_s: float, payload_bytes: int = 100
    ) -> None:
        times = {"age_ns": round(age_s * S), "one_way_delay_ns": round(delay_s * S)}
        self.event("delivered", t_s, topic=topic, number=0, payload_bytes=payload_bytes, **times)


def write_run(folder: Path) -> None:
    """10 s: heartbeats down each second with a growing delay, one plan up, a link of two bands."""
    robot, operator, link = Trace(folder, "robot", ROBOT_NS), Trace(folder, "operator", OPERATOR_NS), Trace(folder, "link", LINK_NS)  # fmt: skip
    for number in range(10):
        operator.delivered(number + 0.5, "heartbeat", age_s=0.1 * (number + 1), delay_s=0.05 * (number + 1))
    robot.delivered(2.0, "plan", age_s=1.0, delay_s=0.75, payload_bytes=800)
    link.event("band", 0, direction="down", rate_bps=1_000_000, one_way_delay_ns=50 * MS)
    link.event("band", 4, direction="down", rate_bps=100_000, one_way_delay_ns=500 * MS)
    for number in range(100):
        dropped = "OVERFLOW" if number == 99 else None
        link.event(
            "packet",
            number / 10,
            direction="down",
            wire_bytes=1000,
            queue_delay_ns=(number + 1) * MS,
            dropped=dropped,
        )
    link.event("packet", 1.0, direction="up", wire_bytes=900, queue_delay_ns=0, dropped=None)
    robot.event("sent", 0.1, interval_ns=100 * MS, wire_bytes=100_000, datagrams=100)
    robot.event(
        "link_state", 0.0, rate_bps=1_000_000, band="fast", rtt_ns=1, in_flight_bytes=0, holding=False
    )
    robot.event("link_state", 5.0, rate_bps=100_000, band="slow", rtt_ns=1, in_flight_bytes=0, holding=False)
    sender = {
        "offered": 20,
        "decimated": 4,
        "superseded": 3,
        "expired": 2,
        "overflow": 1,
        "sent": 11,
        "sent_bytes": 1100,
    }
    receiver = {"delivered": 10, "lost": 1, "received_bytes": 1000}
    silent = dict.fromkeys((*sender, *receiver), 0)
    robot.event("ledger", 10, topics={"heartbeat": {**silent, **sender, "direction": "down"}, "plan": {**silent, "direction": "up", "delivered": 1}})  # fmt: skip
    operator.event("ledger", 10, topics={"heartbeat": {**silent, **receiver, "direction": "down"}, "plan": {**silent, "direction": "up", "offered": 1, "sent": 1}})  # fmt: skip
    facts = {"kind": "mission", "profile": "trials", "seed": 1, "duration_s": 10.0, "start_ns": LINK_NS}
    (folder / "run.json").write_text(json.dumps(facts))


def summary_of(folder: Path) -> tuple[Summary, dict[str, TopicSummary]]:
    summary = summarise(read_run(folder))
    return summary, {row.topic: row for row in summary.topics}


def deliveries(*rows: tuple[float, float]) -> Deliveries:
    """(delivery time, age) in seconds."""
    t_ns = np.array([round(t * S) for t, _ in rows], np.int64)
    age_ns = np.array([round(age * S) for _, age in rows], np.int64)
    return Deliveries(t_ns, age_ns, age_ns, np.full(len(rows), 100))


def test_the_senders_and_the_receivers_counters_make_one_row(tmp_path: Path) -> None:
    write_run(tmp_path)
    _, topics = summary_of(tmp_path)
    row = topics["heartbeat"]
    assert (row.direction, row.offered, row.decimated, row.sent) == ("down", 20, 4, 11)
    assert (row.superseded, row.expired, row.overflow) == (3, 2, 1)
    assert (row.delivered, row.lost, row.payload_bytes) == (10, 1, 1000)
    assert (topics["plan"].direction, topics["plan"].offered, topics["plan"].delivered) == ("up", 1, 1)


def test_delay_and_age_percentiles_are_observed_values(tmp_path: Path) -> None:
    write_run(tmp_path)
    _, topics = summary_of(tmp_path)
    assert topics["heartbeat"].one_way_delay == Spread(250 * MS, 500 * MS, 500 * MS)
    assert topics["heartbeat"].age_at_delivery == Spread(500 * MS, 1000 * MS, 1000 * MS)
    assert topics["plan"].one_way_delay == Spread(750 * MS, 750 * MS, 750 * MS)


def test_the_link_is_judged_by_what_passed_it_and_its_true_rate(tmp_path: Path) -> None:
    write_run(tmp_path)
    summary, _ = summary_of(tmp_path)
    down, up = summary.directions
    assert (down.direction, down.wire_bytes, down.packets, down.dropped) == ("down", 99_000, 100, 1)
    assert down.capacity_bytes == (4 * 1_000_000 + 6 * 100_000) // 8
    assert down.utilisation == pytest.approx(99_000 / 575_000)
    assert down.queue_delay == Spread(50 * MS, 95 * MS, 99 * MS)
    assert (up.wire_bytes, up.capacity_bytes, up.utilisation) == (900, None, None)


def test_bytes_still_waiting_when_the_run_ends_were_not_carried(tmp_path: Path) -> None:
    write_run(tmp_path)
    link = Trace.__new__(Trace)
    link.path, link.clock_ns = tmp_path / "link.jsonl", LINK_NS
    link.event("packet", 9.5, direction="down", wire_bytes=500, queue_delay_ns=S, dropped=None)
    link.event("packet", 9.5, direction="down", wire_bytes=77, queue_delay_ns=S // 4, dropped=None)
    assert summary_of(tmp_path)[0].directions[0].wire_bytes == 99_077


def test_a_delivery_whose_age_nobody_knows_yet_counts_as_delivered_only(tmp_path: Path) -> None:
    write_run(tmp_path)
    operator = Trace.__new__(Trace)
    operator.path, operator.clock_ns = tmp_path / "operator.jsonl", OPERATOR_NS
    early = {"number": 0, "payload_bytes": 100, "age_ns": None, "one_way_delay_ns": None}
    before = summary_of(tmp_path)[1]["heartbeat"]
    operator.event("delivered", 0.1, topic="heartbeat", **early)
    after = summary_of(tmp_path)[1]["heartbeat"]
    assert (after.delivered, after.payload_bytes) == (11, 1100)
    assert after.one_way_delay == before.one_way_delay
    assert after.age_of_information == before.age_of_information


def test_three_clocks_are_put_on_one_time_line(tmp_path: Path) -> None:
    write_run(tmp_path)
    run = read_run(tmp_path)
    assert run.deliveries["heartbeat"].t_ns[0] == S // 2
    assert run.deliveries["plan"].t_ns[0] == 2 * S
    assert list(run.bands["down"].t_ns) == [0, 4 * S]
    assert list(run.estimates["down"].t_ns) == [0, 5 * S]


def test_the_other_directions_estimate_is_what_the_peer_told_where_only_one_side_was_traced(
    tmp_path: Path,
) -> None:
    told = {"rate_bps": 95_000, "queue_ns": 40 * MS, "loss_ratio": 0.1, "confidence": 1.0}
    operator = Trace(tmp_path, "operator", OPERATOR_NS)
    operator.event("link_state", 1, rate_bps=50_000, receiving=None)
    operator.event("link_state", 2, rate_bps=50_000, queue_ns=7 * MS, receiving=told)
    operator.event("link_state", 9, rate_bps=50_000, receiving=None)
    down = read_run(tmp_path).estimates["down"]
    t_ns = np.array([0, S, 2 * S, 8 * S, 9 * S])
    at = [down.at(figures, t_ns) for figures in (down.rate_bps, down.queue_ns, down.loss_ratio)]
    np.testing.assert_array_equal(at[0], [np.nan, np.nan, 95_000, 95_000, np.nan])
    np.testing.assert_array_equal(at[1], [np.nan, np.nan, 40 * MS, 40 * MS, np.nan])
    np.testing.assert_array_equal(at[2], [np.nan, np.nan, 0.1, 0.1, np.nan])


def test_a_senders_own_word_counts_more_than_what_its_peer_was_told(tmp_path: Path) -> None:
    robot, operator = Trace(tmp_path, "robot", ROBOT_NS), Trace(tmp_path, "operator", OPERATOR_NS)
    robot.event("link_state", 1, rate_bps=900_000, queue_ns=0, loss_ratio=0, confidence=1)
    operator.event("link_state", 1, rate_bps=50_000, receiving={"rate_bps": 1000, "queue_ns": 0})
    assert list(read_run(tmp_path).estimates["down"].rate_bps) == [900_000]


def test_a_run_that_starts_after_its_traces_counts_from_its_start(tmp_path: Path) -> None:
    write_run(tmp_path)
    (tmp_path / "run.json").write_text(json.dumps({"duration_s": 9.0, "start_ns": LINK_NS + S}))
    assert read_run(tmp_path).deliveries["plan"].t_ns[0] == S


def test_a_live_run_without_run_json_lasts_until_its_last_event(tmp_path: Path) -> None:
    write_run(tmp_path)
    (tmp_path / "run.json").unlink()
    assert read_run(tmp_path).duration_ns == round(9.9 * S)


def test_a_line_cut_short_by_a_kill_is_counted_and_passed_over(tmp_path: Path) -> None:
    write_run(tmp_path)
    with (tmp_path / "operator.jsonl").open("a") as stream:
        stream.write('{"event":"delivered","t_ns":90')
    with (tmp_path / "robot.jsonl").open("a") as stream:
        stream.write('{"event":"delivered","t_ns":6000000000,"topic":"plan"}\n[1]\n')
    summary, topics = summary_of(tmp_path)
    assert summary.malformed_lines == 3
    assert topics["plan"].delivered == 1


def test_counters_of_a_restarted_side_add_up_and_its_new_clock_is_believed(tmp_path: Path) -> None:
    write_run(tmp_path)
    again = Trace.__new__(Trace)
    again.path, again.clock_ns = tmp_path / "operator.jsonl", 3 * S
    again.line(event="start", t_ns=3 * S, unix_ns=UNIX_NS + 9 * S, side="operator")
    again.delivered(0.75, "heartbeat", age_s=0.1, delay_s=0.1)
    again.event(
        "ledger",
        1,
        topics={"heartbeat": {"direction": "down", "delivered": 1, "lost": 4, "received_bytes": 1}},
    )
    run = read_run(tmp_path)
    assert run.deliveries["heartbeat"].t_ns[-1] == round(9.75 * S)
    assert run.ledgers["heartbeat"]["delivered"] == 11
    assert run.ledgers["heartbeat"]["lost"] == 5


def test_a_folder_without_traces_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ReportError, match="not a run folder"):
        read_run(tmp_path)


def test_age_of_information_is_weighted_by_time() -> None:
    # Ages 1 -> 3 s over [1, 3], then 0.5 -> 7.5 s over [3, 10]: 9 s, half of them below 3 s.
    course = sawtooth(deliveries((1.0, 1.0), (3.0, 0.5)), 10 * S)
    assert course is not None
    assert course.quantiles_ns((0.5, 1.0)) == (round(3.0 * S), round(7.5 * S))
    # 0.5 s in 0.5..1, 4 s more in 1..3 (two ramps), 4.5 s in 3..7.5: 95 % of 9 s at 7.5 - 0.45 s.
    assert course.quantiles_ns((0.95,)) == (round(7.05 * S),)


def test_a_sample_older_than_the_newest_does_not_make_information_younger() -> None:
    plain = sawtooth(deliveries((1.0, 0.1), (5.0, 0.1)), 6 * S)
    with_straggler = sawtooth(deliveries((1.0, 0.1), (2.0, 1.9), (5.0, 0.1)), 6 * S)
    assert plain is not None and with_straggler is not None
    shares = (0.1, 0.5, 0.9, 1.0)
    assert with_straggler.quantiles_ns(shares) == plain.quantiles_ns(shares)


@given(
    st.lists(st.tuples(st.integers(0, 9_999), st.integers(0, 3_000)), min_size=1, max_size=30),
    st.floats(0.01, 1.0),
)
def test_age_quantiles_agree_with_sampling_the_sawtooth(rows: list[tuple[int, int]], share: float) -> None:
    course = sawtooth(deliveries(*((t / 1e3, age / 1e3) for t, age in sorted(rows))), 10 * S)
    assert course is not None
    begin_ns = int(course.begin_ns[0])
    ages = course.at(np.linspace(begin_ns, 10 * S - 1, 20_001).astype(np.int64))
    [quantile_ns] = course.quantiles_ns((share,))
    assert np.mean(ages <= quantile_ns + MS) >= share - 1e-3
    assert np.mean(ages < quantile_ns - MS) <= share + 1e-3


def test_peaks_of_a_bin_are_seen_even_between_its_edges() -> None:
    course = sawtooth(deliveries((1.0, 0.2), (2.5, 0.2)), 4 * S)
    assert course is not None
    peaks = course.peak_between(np.array([0, 1, 2, 3, 4]) * S)
    assert np.isnan(peaks[0])
    assert list(np.round(peaks[1:] / S, 6)) == [1.2, 1.7, 1.7]


def test_nothing_delivered_has_no_age() -> None:
    assert sawtooth(deliveries((11.0, 0.1)), 10 * S) is None
    assert spread(np.empty(0, np.int64)) is None


def test_a_rate_holds_until_the_next_one_and_backwards_from_the_first() -> None:
    steps = Steps(np.array([2, 4]) * S, np.array([10, 20]))
    assert steps.integral(6 * S) == pytest.approx(10 * 4 + 20 * 2)
    assert list(steps.at(np.array([0, 3, 4, 9]) * S)) == [10, 10, 20, 20]


def test_a_recording_alone_tells_deliveries_and_ages(tmp_path: Path) -> None:
    path = tmp_path / "operator.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/imu", "json", 0)
        for number in range(4):
            writer.add_message(
                channel, UNIX_NS + number * S, b"12345", UNIX_NS + number * S - (number + 1) * 100 * MS
            )
        writer.finish()
    summary, topics = summary_of(path)
    assert summary.duration_s == 3.0
    assert (topics["imu"].delivered, topics["imu"].payload_bytes, topics["imu"].offered) == (4, 20, None)
    assert topics["imu"].age_at_delivery == Spread(200 * MS, 400 * MS, 400 * MS)
    assert topics["imu"].one_way_delay is None


def test_the_table_names_every_topic_and_its_figures(tmp_path: Path) -> None:
    write_run(tmp_path)
    text = io.StringIO()
    print_table(summary_of(tmp_path)[0], Console(file=text, width=110))
    assert text.getvalue().count("heartbeat") == text.getvalue().count("plan") == 2
    assert "250 ms" in text.getvalue() and "17.2 %" in text.getvalue()
    assert "…" not in text.getvalue()  # a usual terminal cuts nothing off


def printed(summary: Summary) -> str:
    text = io.StringIO()
    print_table(summary, Console(file=text, width=110))
    return text.getvalue()


def test_the_ages_of_long_names_and_long_delays_fit_a_terminal() -> None:
    late = Spread(99_990 * MS, 99_990 * MS, 99_990 * MS)
    row = TopicSummary("robot/head_camera/overview", "down", None, None, None, 4, None, None, None, None, None, None, None, 20, late, late, late)  # fmt: skip
    text = printed(Summary(3.0, (row,), (), 0))
    assert text.count("99.99 s") == 9
    assert all(word in text for word in ("delay", "delivery", "information")) and "…" not in text


def test_messages_given_up_midway_are_not_lost_too(tmp_path: Path) -> None:
    write_run(tmp_path)
    operator, robot = Trace.__new__(Trace), Trace.__new__(Trace)
    operator.path, operator.clock_ns = tmp_path / "operator.jsonl", OPERATOR_NS
    robot.path, robot.clock_ns = tmp_path / "robot.jsonl", ROBOT_NS
    # Of 20 offered, 3 expired before their last fragment left: the receiver misses their numbers.
    sent = {"direction": "down", "offered": 20, "expired": 3, "superseded": 0, "decimated": 0, "overflow": 0, "sent": 17}  # fmt: skip
    came = {"direction": "down", "delivered": 11, "lost": 5, "stale": 2, "expired": 3}
    robot.event("ledger", 11, topics={"big": sent})
    operator.event("ledger", 11, topics={"big": came})
    summary, topics = summary_of(tmp_path)
    row = topics["big"]
    assert (row.delivered, row.stale, row.expired, row.lost) == (11, 2, 3 + 3, 17 - 11 - 3 - 2)
    assert "stale" in printed(summary)


def test_a_reliable_message_that_came_too_late_counts_once(tmp_path: Path) -> None:
    robot, operator = Trace(tmp_path, "robot", ROBOT_NS), Trace(tmp_path, "operator", OPERATOR_NS)
    operator.event("receipt", 1, topic="plan", tag=1, stage="expired")
    operator.event("ledger", 2, topics={"plan": {"direction": "up", "offered": 3, "expired": 1, "sent": 2}})
    robot.event("ledger", 2, topics={"plan": {"direction": "up", "delivered": 2, "lost": 0, "expired": 1}})
    row = summary_of(tmp_path)[1]["plan"]
    assert (row.offered, row.delivered, row.expired, row.lost) == (3, 2, 1, 0)


def test_the_report_counts_as_the_mission_does(tmp_path: Path) -> None:
    settings = MissionSettings(load_profile("trials"), load_named_or_file("camera-flood"), 60 * S, 1)
    result = run_and_save(settings, tmp_path, None)
    _, topics = summary_of(tmp_path)
    for topic, row in result["topics"].items():
        if row["local"]:
            continue
        found = topics[topic]
        names = ("offered", "decimated", "delivered", "superseded", "expired", "overflow", "stale", "lost")
        told = {name: getattr(found, name) or 0 for name in names}
        assert told == {name: row[name] for name in names}, topic
        assert sum(told.values()) - told["offered"] + row["in_flight"] == told["offered"], topic


@pytest.mark.parametrize(("side", "sends", "receives"), [("robot", "heartbeat", "plan"), ("operator", "plan", "heartbeat")])  # fmt: skip
def test_a_single_trace_of_any_name_tells_what_its_side_knows(
    tmp_path: Path, side: str, sends: str, receives: str
) -> None:
    write_run(tmp_path)
    path = (tmp_path / f"{side}.jsonl").rename(tmp_path / "today.trace")
    summary, topics = summary_of(path)
    assert (topics[sends].delivered, topics[sends].lost, topics[sends].payload_bytes) == (None, None, None)
    assert topics[sends].sent is not None
    assert (topics[receives].offered, topics[receives].sent, topics[receives].expired) == (None, None, None)
    assert topics[receives].delivered == (1 if side == "robot" else 10)
    assert summary.malformed_lines == 0
    [line] = [line for line in printed(summary).splitlines() if sends in line and " B" not in line][:1]
    assert "\N{EN DASH}" in line


def test_what_is_no_run_is_refused_by_what_it_is(tmp_path: Path) -> None:
    with pytest.raises(ReportError, match=r"absent: no such file or folder"):
        read_run(tmp_path / "absent")
    notes = tmp_path / "README.md"
    notes.write_text("# Notes")
    with pytest.raises(ReportError, match=r"README\.md is not an MCAP file, nor a trace"):
        read_run(notes)
    notes.write_text('{"event": "delivered"}\n')
    with pytest.raises(ReportError, match=r"no start line names the side"):
        read_run(notes)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(b"\x89MCAP0\r\n")
    with pytest.raises(ReportError, match=r"cut\.mcap is not a finished MCAP file .*recover it first"):
        read_run(cut)


def test_a_recording_s_age_at_delivery_is_printed(tmp_path: Path) -> None:
    path = tmp_path / "operator.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/imu", "json", 0)
        writer.add_message(channel, UNIX_NS, b"12345", UNIX_NS - 200 * MS)
        writer.finish()
    [line] = [line for line in printed(summary_of(path)[0]).splitlines() if "ms" in line]
    assert "\N{EN DASH} 200 ms 200 ms 200 ms" in " ".join(line.split())  # no one-way delay, but an age


def test_the_table_leaves_out_counters_that_nobody_kept() -> None:
    unknown = [None] * 7
    row = TopicSummary("imu", "down", None, None, None, 4, *unknown, 20, None, None, None)
    text = io.StringIO()
    print_table(Summary(3.0, (row,), (), 0), Console(file=text, width=100))
    assert "delivered" in text.getvalue() and "expired" not in text.getvalue()


@pytest.mark.parametrize(
    ("value_ns", "words"),
    [
        (None, "\N{EN DASH}"),
        (0, "0.0 ms"),
        (1_500_000, "1.5 ms"),
        (56_700_000, "57 ms"),
        (999_400_000, "999 ms"),
        (999_600_000, "1.00 s"),
        (123 * S, "123 s"),
        (-20_000_000, "-20 ms"),
    ],
)
def test_durations_carry_three_digits_and_a_unit(value_ns: int | None, words: str) -> None:
    assert seconds(value_ns) == words


@pytest.mark.parametrize(
    ("value", "words"), [(0, "0 B"), (999, "999 B"), (1_000, "1 kB"), (1_234_567, "1.23 MB")]
)
def test_sizes_are_decimal(value: int, words: str) -> None:
    assert size(value) == words


def test_rates_have_three_digits() -> None:
    told = [rate(value_bps) for value_bps in (999_512, 95_000, 9600, 285e6, 9_999_000, 999_400)]
    assert told == ["1.00 Mbit/s", "95.0 kbit/s", "9.60 kbit/s", "285 Mbit/s", "10.0 Mbit/s", "999 kbit/s"]

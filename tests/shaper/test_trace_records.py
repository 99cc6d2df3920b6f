import json
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from shaper.trace import TraceFile
from shaper.trace_records import BIN_NS, Record, SentBins, event_record, ledger_record, start_record
from tests.shaper.pair import FAST, MS, THIN, Pair, S


@given(st.lists(st.tuples(st.integers(0, 300 * MS), st.integers(29, 1500)), max_size=60))
def test_the_bins_sum_what_was_sent(departures: list[tuple[int, int]]) -> None:
    records: list[Record] = []
    bins = SentBins(records.append)
    expected: dict[int, list[int]] = {}
    t_ns = 7 * S
    for gap_ns, wire_bytes in departures:
        t_ns += gap_ns
        bins.on_sent(wire_bytes, t_ns)
        expected.setdefault(t_ns // BIN_NS * BIN_NS, []).append(wire_bytes)
    bins.flush()
    bins.flush()  # writes nothing twice

    assert [r["t_ns"] for r in records] == sorted(expected)
    assert {r["t_ns"]: (r["wire_bytes"], r["datagrams"]) for r in records} == {
        t: (sum(sizes), len(sizes)) for t, sizes in expected.items()
    }
    assert all(r["interval_ns"] == BIN_NS for r in records)


def busy_pair() -> Pair:
    pair = Pair(bands=(THIN,))
    for i in range(100):
        if i in (1, 99):  # the first and the last of each topic arrive, so that nothing lost goes unseen
            pair.advance(60 * S)
        pair.offer(pair.robot, "robot/state/pose", b"pose")
        pair.offer(pair.robot, "robot/perception/image", bytes(5000))
        pair.offer(pair.robot, "robot/bulk/log", bytes(2000))
        if i % 40 == 3:
            pair.drop(pair.robot)
        pair.advance(50 * MS)
    return pair


def test_the_ledger_record_balances() -> None:
    pair = busy_pair()
    record = ledger_record(pair.robot.endpoint, "down", t_ns=5)
    topics = record["topics"]
    assert isinstance(topics, dict)
    assert list(topics) == ["robot/state/pose", "robot/perception/image", "robot/bulk/log"]
    for counts in topics.values():
        assert counts["direction"] == "down"
        assert counts["offered"] == 100
        left = sum(
            counts[k] for k in ("decimated", "superseded", "expired", "overflow", "refused", "sent", "queued")
        )
        assert left == counts["offered"]
        assert counts["queued"] >= 0
    datagrams = record["datagrams"]
    assert isinstance(datagrams, dict)
    assert datagrams["malformed"] == 0


def test_the_two_ledgers_and_the_datagrams_agree_once_all_has_arrived() -> None:
    pair = busy_pair()
    pair.advance(60 * S)
    sent = ledger_record(pair.robot.endpoint, "down", 0)["topics"]
    received = ledger_record(pair.operator.endpoint, "up", 0)["topics"]
    assert isinstance(sent, dict) and isinstance(received, dict)
    for key, counts in received.items():
        assert counts["direction"] == "down"
        assert sent[key]["sent"] == counts["delivered"] + counts["lost"] + counts["stale"]
    assert sum(counts["lost"] for counts in received.values()) > 0
    arrived_bytes = pair.operator.endpoint.counters.received_wire_bytes
    sent_bytes = pair.robot.endpoint.counters.sent_wire_bytes
    assert arrived_bytes < sent_bytes


def test_every_event_becomes_a_line_that_reads_back(tmp_path: Path) -> None:
    pair = Pair(met=False, bands=(FAST,))
    pair.advance(1 * S)
    pair.offer(pair.robot, "robot/state/pose", b"pose", age_ns=10 * MS)
    pair.advance(1 * S)
    records = [event_record(event, t_ns=9) for event in pair.operator.events]
    assert {r["event"] for r in records} == {"peer_started", "delivered", "link_state"}
    delivered = next(r for r in records if r["event"] == "delivered")
    assert (delivered["topic"], delivered["payload_bytes"], delivered["number"]) == ("robot/state/pose", 4, 0)

    trace = TraceFile(tmp_path / "run" / "robot.jsonl")
    trace.write(start_record("robot", 5, 6))
    for record in records:
        trace.write(record)
    lines = (tmp_path / "run" / "robot.jsonl").read_text().splitlines()  # whole lines before any close
    trace.close()
    assert [json.loads(line) for line in lines] == [
        {"event": "start", "t_ns": 5, "unix_ns": 6, "side": "robot"},
        *records,
    ]

"""Names cross once; after that a process costs three bytes."""

from __future__ import annotations

import pytest

from messages.dccl import Codec
from messages.payload import PayloadError
from messages.process_names import ProcessReader, ProcessReporter, name_hash
from messages.proto.straitlink.bounded.process_report_pb2 import ProcessNames, ProcessReport
from messages.proto.straitlink.process_status_pb2 import ProcessStatus

REPORT, NAMES = Codec(ProcessReport), Codec(ProcessNames)
STATE = ProcessStatus.State


def status(*names: str, state: STATE.ValueType = STATE.STATE_RUNNING) -> ProcessStatus:
    made = ProcessStatus(capture_ns=5)
    for name in names:
        made.processes.add(name=name, host="atlas0", state=state, cpu_ratio=0.25, memory_bytes=40 << 20)
    return made


def test_the_table_is_told_when_processes_come_or_go_and_not_when_they_change_state() -> None:
    reporter = ProcessReporter()
    tables = [
        reporter.report(each)[1] is not None
        for each in (
            status("walk"),
            status("walk", state=STATE.STATE_FAILED),
            status("walk", "see"),
            status("see"),
        )
    ]
    assert tables == [True, False, True, True]


def test_a_report_becomes_a_status_with_names_through_both_codecs() -> None:
    reporter, reader = ProcessReporter(with_load=True), ProcessReader()
    sent = status("walk", "see", "grip")
    report, table = reporter.report(sent)
    assert table is not None
    data = REPORT.encode(report)
    assert len(data) == 19
    assert reader.status(REPORT.decode(data), 5) is None  # its table has not come yet
    reader.learn(NAMES.decode(NAMES.encode(table)))
    assert reader.status(REPORT.decode(data), 5) == sent


def test_a_report_of_twenty_processes_without_load_takes_three_bytes_each() -> None:
    report, _ = ProcessReporter().report(status(*(f"process_{i}" for i in range(20))))
    assert len(REPORT.encode(report)) <= 20 * 3 + 4


def test_names_whose_hashes_meet_are_told_apart() -> None:
    seen: dict[int, str] = {}
    for i in range(70_000):
        name = f"p{i}"
        if (other := seen.get(name_hash("atlas0", name))) is not None:
            break
        seen[name_hash("atlas0", name)] = name
    sent = status(other or "", name)
    reporter, reader = ProcessReporter(), ProcessReader()
    report, table = reporter.report(sent)
    assert table is not None
    reader.learn(table)
    after = reader.status(report, 5)
    assert after is not None
    assert [p.name for p in after.processes] == [other, name]


def test_a_process_that_is_there_twice_is_refused() -> None:
    with pytest.raises(PayloadError, match="'walk' of host 'atlas0' is there more than once"):
        ProcessReporter().report(status("walk", "walk"))

"""Names cross until a report with them has arrived; after that a process costs three bytes."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from messages.payload import Payload, PayloadError
from messages.payload.processes import ProcessEncoding, name_hash
from messages.proto.straitlink.process_status_pb2 import ProcessStatus

STATE = ProcessStatus.State
TYPE = "application/protobuf;straitlink.ProcessStatus"
MAX_BYTES = 100_000
ENCODING = ProcessEncoding()


def status(*names: str, state: STATE.ValueType = STATE.STATE_RUNNING, load: bool = False) -> ProcessStatus:
    made = ProcessStatus(capture_ns=5)
    for name in names:
        process = made.processes.add(name=name, host="atlas0", state=state)
        if load:
            process.cpu_ratio, process.memory_bytes = 0.25, 40 << 20
    return made


def payload(sent: ProcessStatus) -> Payload:
    return Payload(sent.SerializeToString(), TYPE)


def taken(got: Payload) -> ProcessStatus:
    assert got.type == TYPE
    return ProcessStatus.FromString(got.data)


def names_that_meet() -> tuple[str, str]:
    seen: dict[int, str] = {}
    for i in range(70_000):
        if (other := seen.get(name_hash("atlas0", f"p{i}"))) is not None:
            return other, f"p{i}"
        seen[name_hash("atlas0", f"p{i}")] = f"p{i}"
    raise AssertionError("no two of 70,000 names share one of 65,536 hashes")


MEET = names_that_meet()


def test_a_report_becomes_the_status_again_with_names_and_load() -> None:
    sent = status("walk", "see", "grip", load=True)
    data = ENCODING.writer().encode(payload(sent), 0).data
    assert taken(ENCODING.reader().decode(data, 0, TYPE, MAX_BYTES, 5)) == sent


def test_names_cross_until_a_report_with_them_has_arrived() -> None:
    writer = ENCODING.writer()
    names = [f"process_{i}" for i in range(20)]
    first = [len(writer.encode(payload(status(*names)), n).data) for n in (0, 1)]
    writer.on_arrived(0)
    after = len(writer.encode(payload(status(*names)), 2).data)
    another = len(writer.encode(payload(status(*names, "another")), 3).data)
    assert first[0] == first[1] > 300
    assert after <= 20 * 3 + 3
    assert after < another <= after + 22
    writer.on_receiver_restarted()
    assert len(writer.encode(payload(status(*names)), 4).data) == first[0]


@pytest.mark.parametrize(("load", "size"), [(True, 553), (False, 266)])
def test_a_hundred_known_processes_take_what_the_documentation_says(load: bool, size: int) -> None:
    writer = ENCODING.writer()
    sent = payload(status(*(f"p{i}" for i in range(100)), load=load))
    writer.encode(sent, 0)
    writer.on_arrived(0)
    assert len(writer.encode(sent, 1).data) == size


@settings(max_examples=60)
@given(
    st.lists(
        st.tuples(st.sets(st.sampled_from(["walk", "see", *MEET])), st.booleans()), min_size=1, max_size=25
    ),
    st.integers(1, 5),
)
def test_whatever_is_lost_no_process_takes_another_s_name(
    reports: list[tuple[set[str], bool]], round_trip: int
) -> None:
    writer, reader = ENCODING.writer(), ENCODING.reader()
    for n, (names, arrives) in enumerate(reports):
        if n >= round_trip and reports[n - round_trip][1]:
            writer.on_arrived(n - round_trip)
        sent = status(*sorted(names))
        data = writer.encode(payload(sent), n).data
        if arrives:
            assert taken(reader.decode(data, n, TYPE, MAX_BYTES, 5)) == sent


def test_a_report_that_comes_late_is_right_or_refused() -> None:
    writer, reader = ENCODING.writer(), ENCODING.reader()
    reader.decode(writer.encode(payload(status(MEET[0])), 0).data, 0, TYPE, MAX_BYTES, 5)
    writer.on_arrived(0)
    late = writer.encode(payload(status(MEET[0])), 1).data
    moved = status("another", MEET[1])
    assert taken(reader.decode(writer.encode(payload(moved), 2).data, 2, TYPE, MAX_BYTES, 5)) == moved
    with pytest.raises(PayloadError, match="name has not come"):
        reader.decode(late, 1, TYPE, MAX_BYTES, 5)


def test_a_name_that_never_came_is_not_made_up() -> None:
    writer = ENCODING.writer()
    writer.encode(payload(status("walk")), 0)
    writer.on_arrived(0)
    data = writer.encode(payload(status("walk")), 1).data
    with pytest.raises(PayloadError, match="name has not come"):
        ENCODING.reader().decode(data, 1, TYPE, MAX_BYTES, 5)


@pytest.mark.parametrize(
    ("sent", "said"),
    [
        (status("walk", "walk"), "'walk' of host 'atlas0' is there more than once"),
        (status("x" * 64), r"names\[\].name"),
        (status(*(f"p{i}" for i in range(101))), "processes"),
        (ProcessStatus(processes=[ProcessStatus.Process(name="a", cpu_ratio=7.0)]), "cpu_ratio = 7"),
        (ProcessStatus(processes=[ProcessStatus.Process(name="a", cpu_ratio=float("nan"))]), "cpu_ratio"),
    ],
)
def test_what_a_report_cannot_say_is_refused_by_name(sent: ProcessStatus, said: str) -> None:
    with pytest.raises(PayloadError, match=said):
        ENCODING.writer().encode(payload(sent), 0)


@settings(max_examples=200)
@given(st.binary(max_size=80))
def test_any_bytes_are_a_status_or_a_payload_error(data: bytes) -> None:
    reader = ENCODING.reader()
    try:
        reader.decode(data, 0, TYPE, MAX_BYTES, None)
    except PayloadError:
        return


def test_an_encoding_without_state_tells_all_names() -> None:
    sent = status("walk", "see")
    assert taken(ENCODING.decode(ENCODING.encode(payload(sent)).data, TYPE, MAX_BYTES, 5)) == sent

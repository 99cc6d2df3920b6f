import contextlib
import json
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from shaper.datagram import (
    SHARE_OVERHEAD_BYTES,
    append_message,
    decode_datagram,
    message_overhead_bytes,
    write_header,
)
from shaper.errors import DecodeError
from shaper.frames import (
    HEADER_BYTES,
    EstimateFrame,
    Frame,
    Header,
    HelloFrame,
    KnownFrame,
    LedgerFrame,
    MessageFrame,
    Outcome,
    PaddingFrame,
    ReceiptFrame,
    ReportFrame,
    SkipFrame,
    TopicName,
)
from tests.shaper.wire import DATAGRAMS, encode, message_frames

GOLDEN = json.loads((Path(__file__).parents[1] / "golden" / "datagrams.json").read_text())


@settings(max_examples=300)
@given(DATAGRAMS)
def test_every_frame_comes_back_as_it_was_written(datagram: tuple[Header, list[Frame]]) -> None:
    assert decode_datagram(encode(*datagram)) == datagram


@settings(max_examples=300)
@given(st.binary(max_size=80))
@example(b"")
@example(bytes(HEADER_BYTES))
def test_any_bytes_decode_or_raise_a_decode_error(data: bytes) -> None:
    for candidate in (data, b"\x01" + data, b"\x11" + bytes(HEADER_BYTES - 1) + data):
        try:
            header, frames = decode_datagram(candidate)
        except DecodeError:
            continue
        assert header.epoch <= 0xFFFF
        assert len(frames) <= len(candidate)


@settings(max_examples=300)
@given(DATAGRAMS, st.data())
def test_damaged_datagrams_decode_or_raise_a_decode_error(
    datagram: tuple[Header, list[Frame]], data: st.DataObject
) -> None:
    damaged = bytearray(encode(*datagram))
    for _ in range(data.draw(st.integers(1, 3))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(DecodeError):
        decode_datagram(bytes(damaged))


@given(DATAGRAMS)
def test_a_cut_datagram_never_yields_a_frame_that_was_not_sent(datagram: tuple[Header, list[Frame]]) -> None:
    whole = encode(*datagram)
    for length in range(len(whole)):
        try:
            header, frames = decode_datagram(whole[:length])
        except DecodeError:
            continue
        assert header == datagram[0]
        assert frames == datagram[1][: len(frames)]
        assert len(frames) < len(datagram[1])


@given(message_frames(back=st.integers(0, 128 * 128 - 1)))
def test_the_overhead_of_a_message_is_never_underestimated(frame: MessageFrame) -> None:
    total = max(frame.total_bytes, len(frame.data))
    most = message_overhead_bytes(frame.topic_id, frame.age_us, frame.name, frame.offset, total)
    out = bytearray()
    append_message(out, frame)
    assert len(out) - len(frame.data) <= most + (SHARE_OVERHEAD_BYTES if frame.shares_needed else 0)


def test_numbers_and_stamps_go_by_their_low_bits() -> None:
    out = bytearray(HEADER_BYTES)
    write_header(out, Header(7, (5 << 24) + 9, (3 << 32) + 11, True))
    assert decode_datagram(bytes(out))[0] == Header(7, 9, 11, True)


@pytest.mark.parametrize(
    ("body", "reason"),
    [
        ("00", "past the end"),
        ("00" + "0000" + "ffff03", "do not fit"),
        ("06" + "0000" + "ffff03", "do not fit"),
        ("06" + "0000" + "01" + "00" + "0500" + "04", "outcome 4 is unknown"),
        ("07" + "01" + "05", "past the end"),
        ("03" + "00" * 13 + "00" + "09" + "00" * 9, "longer than 64"),
        ("81" + "01" + "0100" + "00" + "01" + "61", "needs no shares"),
        ("82" + "01" + "0100" + "00" + "8002" + "02" + "09" + "01" + "61", "share 256 of 2 for 9 bytes"),
        ("82" + "01" + "0100" + "00" + "00" + "0a" + "09" + "01" + "61", "share 0 of 10 for 9 bytes"),
        ("82" + "01" + "0100" + "00" + "00" + "02" + "03" + "03" + "616263", "share of 3 bytes is none of 2"),
        ("02" + "01" + "0100" + "00" + "00" + "05" + "00", "part of 0 bytes"),
        ("02" + "01" + "0100" + "00" + "04" + "05" + "02" + "6162", "does not fit"),
        ("01" + "01" + "0100" + "00" + "05" + "6162", "past the end"),
        ("09" + "01" + "0100" + "00" + "0100ff" + "0000" + "00", "not UTF-8"),
        ("03" + "00" * 13 + "ffff03", "does not fit"),
        ("05" + "0000" + "ffff03", "do not fit"),
    ],
)
def test_what_is_wrong_is_said(body: str, reason: str) -> None:
    with pytest.raises(DecodeError, match=reason):
        decode_datagram(encode(Header(1, 2, 3, False), []) + bytes.fromhex(body))


def test_another_version_is_refused() -> None:
    with pytest.raises(DecodeError, match="version"):
        decode_datagram(b"\x02" + bytes(HEADER_BYTES - 1))


HEADER = Header(epoch=0xBEEF, number=0x012345, stamp_us=0xDEADBEEF, elicits_report=True)
GOLDEN_DATAGRAMS: dict[str, tuple[Header, list[Frame]]] = {
    "header alone": (Header(1, 2, 3, False), []),
    "message, named": (
        HEADER,
        [
            MessageFrame(
                3, 258, 1500, b"pose", name=TopicName("robot/odometry", "application/cdr", 2000), latest=True
            )
        ],
    ),
    "message, known": (HEADER, [MessageFrame(300, 65535, 200_000, b"pose")]),
    "message, compressed": (HEADER, [MessageFrame(0, 0, 0, b"\x28\xb5\x2f\xfd", compressed=True)]),
    "fragment": (
        HEADER,
        [MessageFrame(4, 9, 70_000, b"middle", offset=1130, total_bytes=16_000, latest=True)],
    ),
    "message, reliable": (HEADER, [MessageFrame(2, 300, 1000, b"step", reliable=True, back=3)]),
    "part, reliable": (
        HEADER,
        [MessageFrame(2, 301, 1000, b"half", offset=600, total_bytes=900, reliable=True, back=4)],
    ),
    "share": (
        HEADER,
        [MessageFrame(4, 10, 70_000, b"parity", offset=14, total_bytes=84, shares_needed=14, latest=True)],
    ),
    "state": (HEADER, [MessageFrame(5, 6, 7, b"entries", latest=True, reliable=True, compressed=True)]),
    "report": (HEADER, [ReportFrame(0xCAFE, 0xABCDEF, 0x01020304, 5000, ((1, 950), (3, 12_000)))]),
    "report, two missing": (
        HEADER,
        [ReportFrame(0xCAFE, 99, 7, 98, ((1, 950),), bytes.fromhex("f7fffffffffdffff"))],
    ),
    "padding": (HEADER, [PaddingFrame(5)]),
    "estimate": (HEADER, [EstimateFrame(949_512, 48, 51 / 255, 1.0, band="950 kbit/s 50 ms")]),
    "estimate, as before": (HEADER, [EstimateFrame(60_000, 0, 0.0, 0.0, holding=True)]),
    "receipt": (
        HEADER,
        [ReceiptFrame(0xCAFE, ((2, 300, Outcome.DELIVERED), (300, 65535, Outcome.EXPIRED)))],
    ),
    "skip": (HEADER, [SkipFrame(2, 302)]),
    "skip, named": (HEADER, [SkipFrame(2, 302, TopicName("a", "", 500))]),
    "ledger, sent half": (
        HEADER,
        [LedgerFrame(0xBEEF, True, ((3, (600, 0, 12, 1, 0, 585, 93_920, 160, 0, 2)),))],
    ),
    "ledger, received half": (
        HEADER,
        [LedgerFrame(0xCAFE, False, ((0, (300, 1, 0, 0, 19_200, 0)), (1, (0, 0, 0, 2, 0, 7))))],
    ),
    "hello": (HEADER, [HelloFrame(1_750_000_000_000_000_000)]),
    "known": (HEADER, [KnownFrame(0xCAFE, (0, 1, 300))]),
    "everything at once": (
        HEADER,
        [
            ReportFrame(1, 2, 3, 4),
            KnownFrame(1, ()),
            HelloFrame(-1),
            MessageFrame(0, 1, 2, b"a"),
            MessageFrame(1, 1, 2, b""),
        ],
    ),
}


@pytest.mark.parametrize("name", GOLDEN_DATAGRAMS)
def test_the_bytes_on_the_wire_are_those_decided_on(name: str) -> None:
    assert encode(*GOLDEN_DATAGRAMS[name]).hex() == GOLDEN[name]
    assert decode_datagram(bytes.fromhex(GOLDEN[name])) == GOLDEN_DATAGRAMS[name]


def test_every_golden_datagram_is_named_here() -> None:
    assert list(GOLDEN) == list(GOLDEN_DATAGRAMS)

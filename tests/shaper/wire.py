"""Any datagram that the wire can carry, for properties; and how it is written."""

from __future__ import annotations

from hypothesis import strategies as st

from shaper.datagram import (
    append_estimate,
    append_hello,
    append_known,
    append_ledger,
    append_message,
    append_padding,
    append_receipt,
    append_report,
    append_skip,
    write_header,
)
from shaper.frames import (
    ARRIVED_BITS,
    HEADER_BYTES,
    MAX_SHARES,
    RECEIVED_COUNTERS,
    SENT_COUNTERS,
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
from shaper.varint import MAX_VALUE

U16 = st.integers(0, 0xFFFF)
U24 = st.integers(0, 0xFF_FFFF)
U32 = st.integers(0, 0xFFFF_FFFF)
VARINT = st.one_of(st.integers(0, 300), st.integers(0, MAX_VALUE))
HEADERS = st.builds(Header, U16, U24, U32, st.booleans(), st.integers(0, 255))
NAMES = st.one_of(st.none(), st.builds(TopicName, st.text(max_size=20), st.text(max_size=10), VARINT))


@st.composite
def message_frames(draw: st.DrawFn, back: st.SearchStrategy[int] = VARINT) -> MessageFrame:
    data = draw(st.binary(max_size=40))
    offset, total, needed = 0, -1, 0
    kind = draw(st.sampled_from(["whole", "part", "share"])) if data else "whole"
    if kind == "part":
        offset = draw(st.integers(0, 1 << 30))
        total = offset + len(data) + draw(st.integers(0, 1 << 30))
        if total == len(data):
            offset, total = 0, -1  # the wire does not tell a part that is all from a whole message
    elif kind == "share":
        needed = draw(st.integers(1, MAX_SHARES))
        offset = draw(st.integers(0, MAX_SHARES - 1))
        smallest = needed * (len(data) - 1) + 1  # of which a share may be as long as this one
        total = max(needed, smallest + draw(st.integers(0, 1 << 20)))
    reliable = draw(st.booleans())
    return MessageFrame(
        draw(VARINT),
        draw(U16),
        draw(VARINT),
        data,
        offset,
        total,
        draw(NAMES),
        latest=draw(st.booleans()),
        compressed=draw(st.booleans()),
        reliable=reliable,
        back=draw(back) if reliable else 0,
        shares_needed=needed,
    )


ARRIVED = st.one_of(st.just(b""), st.binary(max_size=ARRIVED_BITS // 8))
BYTE_RATIOS = st.integers(0, 255).map(lambda byte: byte / 255)
BAND_NAMES = st.none() | st.text(max_size=32).filter(lambda name: len(name.encode()) <= 32)
RECEIPTS = st.lists(st.tuples(VARINT, U16, st.sampled_from(Outcome)), max_size=10).map(tuple)


@st.composite
def ledger_frames(draw: st.DrawFn) -> LedgerFrame:
    sent_half = draw(st.booleans())
    counters = SENT_COUNTERS if sent_half else RECEIVED_COUNTERS
    row = st.tuples(VARINT, st.tuples(*[VARINT] * counters))
    return LedgerFrame(draw(U16), sent_half, tuple(draw(st.lists(row, max_size=4))))


FRAMES = st.one_of(
    message_frames(),
    st.builds(
        ReportFrame, U16, U24, U32, U32, st.lists(st.tuples(VARINT, VARINT), max_size=10).map(tuple), ARRIVED
    ),
    st.builds(HelloFrame, st.integers(-(1 << 63), (1 << 63) - 1)),
    st.builds(PaddingFrame, st.integers(0, 300)),
    st.builds(EstimateFrame, VARINT, VARINT, BYTE_RATIOS, BYTE_RATIOS, st.booleans(), BAND_NAMES),
    st.builds(KnownFrame, U16, st.lists(VARINT, max_size=10).map(tuple)),
    st.builds(ReceiptFrame, U16, RECEIPTS),
    st.builds(SkipFrame, VARINT, U16, NAMES),
    ledger_frames(),
)
DATAGRAMS = st.tuples(HEADERS, st.lists(FRAMES, max_size=4))


def encode(header: Header, frames: list[Frame]) -> bytes:
    out = bytearray(HEADER_BYTES)
    write_header(out, header)
    for frame in frames:
        match frame:
            case MessageFrame():
                append_message(out, frame)
            case ReportFrame():
                append_report(out, frame)
            case HelloFrame():
                append_hello(out, frame)
            case PaddingFrame():
                append_padding(out, frame)
            case EstimateFrame():
                append_estimate(out, frame)
            case KnownFrame():
                append_known(out, frame)
            case ReceiptFrame():
                append_receipt(out, frame)
            case SkipFrame():
                append_skip(out, frame)
            case LedgerFrame():
                append_ledger(out, frame)
    return bytes(out)

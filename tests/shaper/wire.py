"""Any datagram that the wire can carry, for properties; and how it is written."""

from __future__ import annotations

from hypothesis import strategies as st

from shaper.datagram import (
    HEADER_BYTES,
    Frame,
    Header,
    HelloFrame,
    KnownFrame,
    MessageFrame,
    ReportFrame,
    TopicName,
    append_hello,
    append_known,
    append_message,
    append_report,
    write_header,
)
from shaper.varint import MAX_VALUE

U16 = st.integers(0, 0xFFFF)
U24 = st.integers(0, 0xFF_FFFF)
U32 = st.integers(0, 0xFFFF_FFFF)
VARINT = st.one_of(st.integers(0, 300), st.integers(0, MAX_VALUE))
HEADERS = st.builds(Header, U16, U24, U32, st.booleans())
NAMES = st.one_of(st.none(), st.builds(TopicName, st.text(max_size=20), st.text(max_size=10)))


@st.composite
def message_frames(draw: st.DrawFn) -> MessageFrame:
    data = draw(st.binary(max_size=40))
    offset, total = 0, -1
    if data and draw(st.booleans()):
        offset = draw(st.integers(0, 1 << 30))
        total = offset + len(data) + draw(st.integers(0, 1 << 30))
        if total == len(data):
            offset, total = 0, -1  # the wire does not tell a part that is all from a whole message
    return MessageFrame(
        draw(VARINT),
        draw(U16),
        draw(VARINT),
        data,
        offset,
        total,
        draw(NAMES),
        draw(st.booleans()),
        draw(st.booleans()),
    )


FRAMES = st.one_of(
    message_frames(),
    st.builds(ReportFrame, U16, U24, U32, U32, st.lists(st.tuples(VARINT, VARINT), max_size=10).map(tuple)),
    st.builds(HelloFrame, st.integers(-(1 << 63), (1 << 63) - 1)),
    st.builds(KnownFrame, U16, st.lists(VARINT, max_size=10).map(tuple)),
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
            case KnownFrame():
                append_known(out, frame)
    return bytes(out)

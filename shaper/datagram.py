"""The link's wire: one datagram is an 11-byte header and frames. See docs/wire_format.md.

Header: version and flags (1 B), epoch (2 B), packet number (3 B), send stamp (4 B), promise (1 B),
little-endian.
The epoch is drawn at random when a daemon starts, so the peer can tell a restart; packet numbers
count from 0 in each epoch and are sent by their low 24 bits; the send stamp is the sender's monotonic
clock in microseconds, modulo 2^32; the promise is a code of shaper.promise.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

from shaper.errors import DecodeError
from shaper.frames import (
    ARRIVED_BITS,
    HEADER_BYTES,
    MAX_BAND_BYTES,
    MAX_SHARES,
    RECEIVED_COUNTERS,
    SENT_COUNTERS,
    VERSION,
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
from shaper.varint import MAX_VALUE, append_varint, read_varint, varint_bytes

_HEADER = struct.Struct("<BHHBIB")  # version/flags, epoch, number low 16, number high 8, stamp, promise
_ELICITS_REPORT = 0x10

_LEDGER, _MESSAGE, _PART, _REPORT, _HELLO, _KNOWN, _RECEIPT, _SKIP = range(8)
_TYPE_MASK = 0x07
_NAMED, _LATEST, _COMPRESSED, _RELIABLE, _CODED = 0x08, 0x10, 0x20, 0x40, 0x80
_PADDING = 0x08  # of a hello: it is none, but so many zero bytes
_ESTIMATE, _WITH_BAND, _HOLDING = 0x10, 0x20, 0x40  # of a hello: it is none, but an estimate
_SENT_HALF = 0x08  # of a ledger frame: the sender's counters, not the receiver's

_OUTCOMES = frozenset(Outcome)
_NUMBER = struct.Struct("<H")
_RECEIPT_ROW = struct.Struct("<HB")
_HELLO_BODY = struct.Struct("<q")
_REPORT_BODY = struct.Struct("<HHBII")  # epoch reported on, largest number, its arrival stamp, received


def write_header(out: bytearray, header: Header) -> None:
    """Write the header over the first bytes; the number and the stamp are cut to their low bits."""
    number = header.number & 0xFF_FFFF
    _HEADER.pack_into(
        out,
        0,
        VERSION | (_ELICITS_REPORT if header.elicits_report else 0),
        header.epoch,
        number & 0xFFFF,
        number >> 16,
        header.stamp_us & 0xFFFF_FFFF,
        header.promise,
    )


def message_overhead_bytes(
    topic_id: int, age_us: int, name: TopicName | None, offset: int, total_bytes: int
) -> int:
    """The most that the frame of a message, or of a part of it, takes besides its data."""
    size = (
        5  # kind, number, and two bytes of `back`
        + varint_bytes(topic_id)
        + varint_bytes(age_us)
        + varint_bytes(offset)
        + 2 * varint_bytes(total_bytes)
    )
    if name is not None:
        size += 4 + len(name.key.encode()) + len(name.encoding.encode()) + varint_bytes(name.ttl_ms)
    return size


SHARE_OVERHEAD_BYTES = 3  # a share says how many are needed, and its index may take two bytes


def append_message(out: bytearray, frame: MessageFrame) -> None:
    """Write a message, a part of one or a share."""
    whole = frame.is_whole
    out.append(
        (_MESSAGE if whole else _PART)
        | (_NAMED if frame.name is not None else 0)
        | (_LATEST if frame.latest else 0)
        | (_COMPRESSED if frame.compressed else 0)
        | (_RELIABLE if frame.reliable else 0)
        | (_CODED if frame.shares_needed else 0)
    )
    append_varint(out, frame.topic_id)
    out += _NUMBER.pack(frame.number & 0xFFFF)
    append_varint(out, frame.age_us)
    if frame.reliable:
        append_varint(out, frame.back)
    if frame.name is not None:
        _append_name(out, frame.name)
    if not whole:
        append_varint(out, frame.offset)
        if frame.shares_needed:
            append_varint(out, frame.shares_needed)
        append_varint(out, frame.total_bytes)
    append_varint(out, len(frame.data))
    out += frame.data


def append_report(out: bytearray, frame: ReportFrame) -> None:
    """Write a receiver report."""
    out.append(_REPORT)
    largest = frame.largest & 0xFF_FFFF
    out += _REPORT_BODY.pack(
        frame.epoch,
        largest & 0xFFFF,
        largest >> 16,
        frame.arrival_us & 0xFFFF_FFFF,
        frame.received & 0xFFFF_FFFF,
    )
    append_varint(out, len(frame.earlier))
    for numbers_before, us_before in frame.earlier:
        append_varint(out, numbers_before)
        append_varint(out, max(0, us_before))
    append_varint(out, len(frame.arrived))
    out += frame.arrived


def append_hello(out: bytearray, frame: HelloFrame) -> None:
    """Write the sender's wall clock."""
    out.append(_HELLO)
    out += _HELLO_BODY.pack(frame.unix_ns)


def append_estimate(out: bytearray, frame: EstimateFrame) -> None:
    """Write what the sender takes its own direction for; a band's name is cut to MAX_BAND_BYTES."""
    with_band, holding = _WITH_BAND if frame.band is not None else 0, _HOLDING if frame.holding else 0
    out.append(_HELLO | _ESTIMATE | with_band | holding)
    append_varint(out, frame.rate_bps)
    append_varint(out, frame.queue_ms)
    out += bytes(round(255 * ratio) for ratio in (frame.loss_ratio, frame.confidence))
    if frame.band is not None:
        name = frame.band.encode()[:MAX_BAND_BYTES].decode(errors="ignore").encode()
        out.append(len(name))
        out += name


def append_padding(out: bytearray, frame: PaddingFrame) -> None:
    """Write bytes that say nothing."""
    out.append(_HELLO | _PADDING)
    append_varint(out, frame.padding_bytes)
    out += bytes(frame.padding_bytes)


def append_known(out: bytearray, frame: KnownFrame) -> None:
    """Write which topic ids need no name any more."""
    out.append(_KNOWN)
    out += _NUMBER.pack(frame.epoch)
    append_varint(out, len(frame.topic_ids))
    for topic_id in frame.topic_ids:
        append_varint(out, topic_id)


def append_receipt(out: bytearray, frame: ReceiptFrame) -> None:
    """Write what became of reliable messages."""
    out.append(_RECEIPT)
    out += _NUMBER.pack(frame.epoch)
    append_varint(out, len(frame.receipts))
    for topic_id, number, outcome in frame.receipts:
        append_varint(out, topic_id)
        out += _RECEIPT_ROW.pack(number & 0xFFFF, outcome)


def append_skip(out: bytearray, frame: SkipFrame) -> None:
    """Write which reliable messages will not come any more."""
    out.append(_SKIP | (_NAMED if frame.name is not None else 0))
    append_varint(out, frame.topic_id)
    out += _NUMBER.pack(frame.number & 0xFFFF)
    if frame.name is not None:
        _append_name(out, frame.name)


def append_ledger(out: bytearray, frame: LedgerFrame) -> None:
    """Write counters; those that outgrow a varint go round."""
    out.append(_LEDGER | (_SENT_HALF if frame.sent_half else 0))
    out += _NUMBER.pack(frame.epoch)
    append_varint(out, len(frame.rows))
    for topic_id, counters in frame.rows:
        append_varint(out, topic_id)
        for counter in counters:
            append_varint(out, counter & MAX_VALUE)


def decode_datagram(data: bytes) -> tuple[Header, list[Frame]]:
    """Header and frames of a datagram. Returns, or raises DecodeError and nothing else."""
    if len(data) < HEADER_BYTES:
        raise DecodeError(f"{len(data)} bytes are shorter than a header ({HEADER_BYTES})")
    first, epoch, number_low, number_high, stamp_us, promise = _HEADER.unpack_from(data)
    if first & ~_ELICITS_REPORT != VERSION:
        raise DecodeError(f"version and flags {first:#04x} are unknown")
    elicits_report = bool(first & _ELICITS_REPORT)
    header = Header(epoch, number_high << 16 | number_low, stamp_us, elicits_report, promise)
    frames: list[Frame] = []
    at = HEADER_BYTES
    while at < len(data):
        frame, at = _READERS[data[at] & _TYPE_MASK](data, at)
        frames.append(frame)
    return header, frames


def _append_name(out: bytearray, name: TopicName) -> None:
    _append_text(out, name.key)
    _append_text(out, name.encoding)
    append_varint(out, name.ttl_ms)


def _append_text(out: bytearray, text: str) -> None:
    raw = text.encode()
    out += _NUMBER.pack(len(raw))
    out += raw


def _read_text(data: bytes, at: int) -> tuple[str, int]:
    raw, at = _take(data, at + 2, _unpack(_NUMBER, data, at)[0])
    try:
        return raw.decode(), at
    except UnicodeDecodeError as error:
        raise DecodeError(f"a topic name at byte {at} is not UTF-8") from error


def _take(data: bytes, at: int, count: int) -> tuple[bytes, int]:
    if at + count > len(data):
        raise DecodeError(f"{count} bytes from byte {at} run past the end of the datagram")
    return data[at : at + count], at + count


def _unpack(layout: struct.Struct, data: bytes, at: int) -> tuple[int, ...]:
    if at + layout.size > len(data):
        raise DecodeError(f"{layout.size} bytes from byte {at} run past the end of the datagram")
    return layout.unpack_from(data, at)


def _read_message(data: bytes, at: int) -> tuple[Frame, int]:
    kind = data[at]
    topic_id, at = read_varint(data, at + 1)
    (number,) = _unpack(_NUMBER, data, at)
    age_us, at = read_varint(data, at + 2)
    back = 0
    if kind & _RELIABLE:
        back, at = read_varint(data, at)
    name = None
    if kind & _NAMED:
        name, at = _read_name(data, at)
    offset, total_bytes, shares_needed = 0, -1, 0
    if kind & _TYPE_MASK == _PART:
        offset, at = read_varint(data, at)
        if kind & _CODED:
            shares_needed, at = read_varint(data, at)
        total_bytes, at = read_varint(data, at)
    count, at = read_varint(data, at)
    body, at = _take(data, at, count)
    if shares_needed:
        _check_share(offset, shares_needed, total_bytes, count)
    elif kind & _CODED:
        raise DecodeError(f"a message at byte {at} is coded, but needs no shares")
    elif total_bytes >= 0 and (count == 0 or offset + count > total_bytes):
        raise DecodeError(f"a part of {count} bytes at {offset} does not fit a message of {total_bytes}")
    return (
        MessageFrame(
            topic_id,
            number,
            age_us,
            body,
            offset,
            total_bytes,
            name,
            bool(kind & _LATEST),
            bool(kind & _COMPRESSED),
            bool(kind & _RELIABLE),
            back,
            shares_needed,
        ),
        at,
    )


def _check_share(index: int, needed: int, total_bytes: int, count: int) -> None:
    if not (index < MAX_SHARES and needed <= MAX_SHARES and needed <= total_bytes):
        raise DecodeError(f"share {index} of {needed} for {total_bytes} bytes cannot be")
    if not 0 < count <= -(-total_bytes // needed):
        raise DecodeError(f"a share of {count} bytes is none of {needed} for {total_bytes} bytes")


def _read_name(data: bytes, at: int) -> tuple[TopicName, int]:
    key, at = _read_text(data, at)
    encoding, at = _read_text(data, at)
    ttl_ms, at = read_varint(data, at)
    return TopicName(key, encoding, ttl_ms), at


def _read_report(data: bytes, at: int) -> tuple[Frame, int]:
    epoch, low, high, arrival_us, received = _unpack(_REPORT_BODY, data, at + 1)
    count, at = read_varint(data, at + 1 + _REPORT_BODY.size)
    if count > len(data):
        raise DecodeError(f"a report of {count} arrivals does not fit a datagram of {len(data)} bytes")
    earlier = []
    for _ in range(count):
        numbers_before, at = read_varint(data, at)
        us_before, at = read_varint(data, at)
        earlier.append((numbers_before, us_before))
    size, at = read_varint(data, at)
    if size * 8 > ARRIVED_BITS:
        raise DecodeError(f"a report of {size * 8} arrivals is longer than {ARRIVED_BITS}")
    arrived, at = _take(data, at, size)
    return ReportFrame(epoch, high << 16 | low, arrival_us, received, tuple(earlier), arrived), at


def _read_hello(data: bytes, at: int) -> tuple[Frame, int]:
    if data[at] & _PADDING:
        count, at = read_varint(data, at + 1)
        _, at = _take(data, at, count)
        return PaddingFrame(count), at
    if data[at] & _ESTIMATE:
        return _read_estimate(data, at)
    return HelloFrame(_unpack(_HELLO_BODY, data, at + 1)[0]), at + 1 + _HELLO_BODY.size


def _read_estimate(data: bytes, at: int) -> tuple[Frame, int]:
    kind = data[at]
    rate_bps, at = read_varint(data, at + 1)
    queue_ms, at = read_varint(data, at)
    (loss, confidence), at = _take(data, at, 2)
    band = None
    if kind & _WITH_BAND:
        (size,), at = _take(data, at, 1)
        if size > MAX_BAND_BYTES:
            raise DecodeError(f"a band's name of {size} bytes is longer than {MAX_BAND_BYTES}")
        raw, at = _take(data, at, size)
        try:
            band = raw.decode()
        except UnicodeDecodeError as error:
            raise DecodeError(f"a band's name before byte {at} is not UTF-8") from error
    holding = bool(kind & _HOLDING)
    return EstimateFrame(rate_bps, queue_ms, loss / 255, confidence / 255, holding, band), at


def _read_known(data: bytes, at: int) -> tuple[Frame, int]:
    (epoch,) = _unpack(_NUMBER, data, at + 1)
    count, at = read_varint(data, at + 1 + _NUMBER.size)
    if count > len(data):
        raise DecodeError(f"{count} topic ids do not fit a datagram of {len(data)} bytes")
    topic_ids = []
    for _ in range(count):
        topic_id, at = read_varint(data, at)
        topic_ids.append(topic_id)
    return KnownFrame(epoch, tuple(topic_ids)), at


def _read_receipt(data: bytes, at: int) -> tuple[Frame, int]:
    (epoch,) = _unpack(_NUMBER, data, at + 1)
    count, at = read_varint(data, at + 1 + _NUMBER.size)
    if count > len(data):
        raise DecodeError(f"{count} receipts do not fit a datagram of {len(data)} bytes")
    receipts = []
    for _ in range(count):
        topic_id, at = read_varint(data, at)
        number, outcome = _unpack(_RECEIPT_ROW, data, at)
        at += _RECEIPT_ROW.size
        if outcome not in _OUTCOMES:
            raise DecodeError(f"a receipt's outcome {outcome} is unknown")
        receipts.append((topic_id, number, Outcome(outcome)))
    return ReceiptFrame(epoch, tuple(receipts)), at


def _read_skip(data: bytes, at: int) -> tuple[Frame, int]:
    kind = data[at]
    topic_id, at = read_varint(data, at + 1)
    (number,) = _unpack(_NUMBER, data, at)
    at += _NUMBER.size
    name = None
    if kind & _NAMED:
        name, at = _read_name(data, at)
    return SkipFrame(topic_id, number, name), at


def _read_ledger(data: bytes, at: int) -> tuple[Frame, int]:
    sent_half = bool(data[at] & _SENT_HALF)
    counters = SENT_COUNTERS if sent_half else RECEIVED_COUNTERS
    (epoch,) = _unpack(_NUMBER, data, at + 1)
    count, at = read_varint(data, at + 1 + _NUMBER.size)
    if count * (counters + 1) > len(data):
        raise DecodeError(f"{count} ledger rows do not fit a datagram of {len(data)} bytes")
    rows = []
    for _ in range(count):
        topic_id, at = read_varint(data, at)
        values = []
        for _ in range(counters):
            value, at = read_varint(data, at)
            values.append(value)
        rows.append((topic_id, tuple(values)))
    return LedgerFrame(epoch, sent_half, tuple(rows)), at


_READERS: dict[int, Callable[[bytes, int], tuple[Frame, int]]] = {
    _MESSAGE: _read_message,
    _PART: _read_message,
    _REPORT: _read_report,
    _HELLO: _read_hello,
    _KNOWN: _read_known,
    _RECEIPT: _read_receipt,
    _SKIP: _read_skip,
    _LEDGER: _read_ledger,
}

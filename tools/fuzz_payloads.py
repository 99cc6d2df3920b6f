"""What the fuzzer does with messages in the forms in which they cross: every decoder of `messages`."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache

import zstandard

from messages.attachment import Stamp, decode_stamp
from messages.bounded_catalogue import BOUNDED_CATALOGUE
from messages.dccl import ArithmeticModel, Codec, DcclError, SchemaError
from messages.payload import Payload, PayloadError
from messages.payload.bounded import BoundedEncoding
from messages.payload.delta import DeltaEncoding
from messages.payload.dictionary import DictionaryEncoding
from messages.payload.maps import maps_of
from messages.payload.processes import ProcessEncoding
from messages.proto.straitlink.process_status_pb2 import ProcessStatus
from tests.messages.dccl.declare import Declared, declare, number
from tools.fuzz_parts import join_parts, split_parts

_MAX_BYTES = 20_000
_CAPTURES_NS = (None, 0, 1_750_000_000 * 10**9, (1 << 62) - 1, -1)
_ARITHMETIC = ArithmeticModel("counts", (5, 3, 1), (0, 1, 2, 3), eof_frequency=2, out_of_range_frequency=1)


def bounded(data: bytes) -> None:
    """A message of the catalogue, in any of the types that a bus may want of it."""
    if len(data) < 3:
        return
    encodings = _bounded_encodings()
    encoding = encodings[data[0] % len(encodings)]
    types = encoding.bus_types
    bus_type, capture_ns = types[data[1] % len(types)], _CAPTURES_NS[data[2] % len(_CAPTURES_NS)]
    with suppress(PayloadError):
        _check(encoding.decode(data[3:], bus_type, _MAX_BYTES, capture_ns))


def stream(data: bytes) -> None:
    """Messages one after the other to the receiver of a stream: differences, names that cross once."""
    parts = list(split_parts(data))
    if not parts or not parts[0]:
        return
    encodings = _stream_encodings()
    encoding = encodings[parts[0][0] % len(encodings)]
    reader, message_number = encoding.reader(), 1000
    for part in parts[1:]:
        message_number += part[0] % 8 - 2 if part else 1
        bus_type = encoding.bus_types[len(part) % len(encoding.bus_types)]
        with suppress(PayloadError):
            _check(reader.decode(part[1:], message_number, bus_type, _MAX_BYTES, _CAPTURES_NS[2]))


def dictionary(data: bytes) -> None:
    """A payload under a zstd dictionary."""
    with suppress(PayloadError):
        _check(_dictionary().decode(data, "application/json", _MAX_BYTES, None))


def dccl(data: bytes) -> None:
    """Every kind of field, in every version of DCCL's wire format and in our own codecs."""
    if len(data) < 2:
        return
    codecs = _codecs()
    codec, how = codecs[data[0] % len(codecs)], data[1] % 3
    with suppress(DcclError):
        (codec.decode, codec.decode_prefix, codec.decode_head)[how](data[2:], _CAPTURES_NS[2])


def stamp(data: bytes) -> None:
    """What rides beside a message on a bus."""
    decode_stamp(data)


TARGETS: dict[str, Callable[[bytes], None]] = {
    each.__name__: each for each in (bounded, stream, dictionary, dccl, stamp)
}


def seeds() -> dict[str, list[bytes]]:
    """True messages of each kind."""
    return {
        "bounded": [
            bytes([index, which, 2]) + data
            for index, encoding in enumerate(_bounded_encodings())
            for which, data in enumerate(_true_messages(encoding.codec))
        ],
        "stream": list(_stream_seeds()),
        "dictionary": [
            _dictionary().encode(Payload(data, "")).data for data in (b"", _samples()[7], bytes(3000))
        ],
        "dccl": [
            bytes([index, how]) + data
            for index, codec in enumerate(_codecs())
            for how, data in enumerate(_true_messages(codec))
        ],
        "stamp": [Stamp(1_750_000_000 * 10**9, 9).encode()],
    }


class _Known(BoundedEncoding):
    """An encoding of the catalogue that tells which types it can give."""

    @property
    def bus_types(self) -> list[str]:
        return list(self._maps)


class _KnownDelta(DeltaEncoding, _Known):
    """The same for differences."""


class _KnownProcesses(ProcessEncoding, _Known):
    """The same for processes."""


def _check(payload: Payload) -> None:
    assert len(payload.data) <= _MAX_BYTES, f"{len(payload.data)} bytes came out, {_MAX_BYTES} may"


@cache
def _bounded_encodings() -> list[_Known]:
    return [_Known(each.message_type, maps_of(each.message_type)) for each in BOUNDED_CATALOGUE]


@cache
def _stream_encodings() -> list[_KnownDelta | _KnownProcesses]:
    made: list[_KnownDelta | _KnownProcesses] = [_KnownProcesses()]
    for each in BOUNDED_CATALOGUE:
        with suppress(SchemaError):  # text and lists of messages have no differences
            made.append(_KnownDelta(each.message_type, maps_of(each.message_type)))
    return made


@cache
def _samples() -> list[bytes]:
    return [b'{"process": "walk_%d", "load": 0.%d}' % (i % 40, i * 7919 % 997) for i in range(2000)]


@cache
def _dictionary() -> DictionaryEncoding:
    return DictionaryEncoding(zstandard.train_dictionary(2048, list(_samples()), k=200, d=8).as_bytes())


@cache
def _codecs() -> list[Codec]:
    return [*(Codec(declare(*_fields(), version=version)) for version in (2, 3, 4)), _arithmetic(), _own()]


def _fields() -> Iterable[Declared]:
    yield number("x", -100, 100, precision=2)
    yield number("n", 0, 1000, "uint32", "optional", in_head=True)
    yield number("list", -5, 5, "int32", "repeated", max_repeat=6)
    yield Declared("flag", "bool", "optional")
    yield Declared("text", "string", "optional", {"max_length": 20})
    yield Declared("blob", "bytes", "optional", {"max_length": 9})
    yield Declared("kind", "enum", "optional", enum=[("A", 3), ("B", 1), ("C", 7)])
    inner = (number("y", 0, 1, precision=3), Declared("name", "string", "optional", {"max_length": 5}))
    yield Declared("inner", "message", "repeated", {"max_repeat": 3}, message=inner)


def _arithmetic() -> Codec:
    field = {"codec": "dccl.arithmetic", "arithmetic": "counts", "max_repeat": 8}
    return Codec(declare(Declared("a", "int32", "repeated", field)), arithmetic_models=[_ARITHMETIC])


def _own() -> Codec:
    turn = {"codec": "straitlink.quaternion.1", "resolution": 0.002, "min_repeat": 4, "max_repeat": 4}
    time = {"codec": "straitlink.time.1", "max": 60, "resolution": 0.001}
    return Codec(
        declare(
            Declared("t", "double", "required", time),
            Declared("q", "double", "repeated", turn),
            number("j", -4, 4, "double", "repeated", resolution=0.001, max_repeat=12),
            Declared("mode", "enum", "required", enum=[("A", 3), ("B", 1), ("C", 7)]),
            codec_group="straitlink.1",
        )
    )


def _true_message(codec: Codec, noise: Callable[[int], bytes], length: int) -> bytes | None:
    """A message of this type and of about this length, as the codec itself would write it."""
    head = codec.schema.id_wire.to_bytes(-(-codec.schema.id_bits // 8), "little")
    for _ in range(500):
        with suppress(DcclError):
            message, _ = codec.decode_prefix(head + noise(length), _CAPTURES_NS[2])
            return codec.encode(message)
    return None


def _true_messages(codec: Codec) -> list[bytes]:
    noise = random.Random(codec.schema.name).randbytes
    lengths = (codec.max_size, codec.min_size + 40, codec.min_size)
    found = [_true_message(codec, noise, length) for length in lengths]
    return [data for data in found if data is not None and len(data) < 600][:2]


def _stream_seeds() -> Iterable[bytes]:
    for index, encoding in enumerate(_stream_encodings()):
        writer, parts = encoding.writer(), [bytes([index])]
        for at, payload in enumerate(_payloads(encoding)):
            with suppress(PayloadError):
                parts.append(b"\3" + writer.encode(payload, 1001 + at).data)
                writer.on_arrived(1001 + at)
        yield join_parts(parts)


def _payloads(encoding: _KnownDelta | _KnownProcesses) -> list[Payload]:
    if isinstance(encoding, _KnownProcesses):
        status = ProcessStatus()
        for name in ("walk", "see", "hold"):
            status.processes.add(name=name, host="atlas0", cpu_ratio=0.25)
        return [Payload(status.SerializeToString(), encoding.bus_types[-1])] * 2
    messages = [encoding.codec.decode(data, _CAPTURES_NS[2]) for data in _true_messages(encoding.codec)]
    return [Payload(message.SerializeToString(), encoding.bus_types[0]) for message in messages * 2]

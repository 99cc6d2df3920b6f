"""Encode and decode one message type in DCCL's wire format, with a schema that is compiled once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

from google.protobuf.message import Message as ProtobufMessage

from messages.dccl.arithmetic import ArithmeticModel, ModelInUse
from messages.dccl.batch import Batch, Columns
from messages.dccl.conditions import ConditionError
from messages.dccl.custom import FieldCodecs
from messages.dccl.decoder import Decoder, compile_decoder
from messages.dccl.encoder import Policy, compile_encoder
from messages.dccl.encryption import body_cipher
from messages.dccl.errors import DecodeError, EncodeError, SchemaError, told_of
from messages.dccl.fields import Field, Message, MessageWire
from messages.dccl.info import SchemaInfo, describe
from messages.dccl.limits import Deviation, Deviations, Treatment
from messages.dccl.options import as_descriptor
from messages.dccl.schema import load_schema

M = TypeVar("M", bound=ProtobufMessage)

OutOfRange = Treatment | Mapping[str, Treatment]

_NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Encoded:
    """A message's bytes, and what in them is not as the message had it."""

    data: bytes
    deviations: tuple[Deviation, ...]


class Codec(Generic[M]):
    """DCCL codec versions 2, 3 and 4 for one message type, byte for byte those of the C++ library.

    message_type: a protobuf class with (dccl.msg) and (dccl.field) options, of any descriptor pool.
    strict: what does not fit raises EncodeError, and bytes after a message raise DecodeError; without it,
    long strings and lists are cut, and what follows a message is left alone, as in DCCL.
    out_of_range: for numbers beyond their bounds and NaN: "raise" (the default if strict), "clamp" to the
    nearest bound, "dccl" (the default if not strict): zero bits, which read as unset, or as the minimum of
    a required field. One for all, or by field path ("pose.x", "arm[].angle"; "*" for the others).
    field_codecs: by the name that stands in a codec or codec_group option.
    arithmetic_models: by the name that stands in [arithmetic].model.
    peer_hash: what a dccl.hash field carries, where the other side is not ours; None for schema_hash.
    insecure_passphrase: DCCL's own encryption, for systems that have it. Not for new traffic: messages with
    the same head share a key stream, and nothing is authenticated (see messages.dccl.encryption).

    Raises SchemaError for a declaration that DCCL refuses. After that, encoding raises EncodeError only,
    decoding DecodeError only.
    """

    def __init__(
        self,
        message_type: type[M],
        strict: bool = True,
        *,
        out_of_range: OutOfRange | None = None,
        field_codecs: FieldCodecs | None = None,
        arithmetic_models: Iterable[ArithmeticModel] = (),
        peer_hash: int | None = None,
        insecure_passphrase: str | None = None,
    ) -> None:
        models = {model.name: ModelInUse(model) for model in arithmetic_models}
        self._adaptive = [use for use in models.values() if use.model.is_adaptive]
        self.message_type = message_type
        self.schema = load_schema(as_descriptor(message_type), field_codecs or {}, models, strict)
        self.schema_hash = self.schema.hash()
        self._is_strict = strict
        self.wire_hash = self.schema_hash if peer_hash is None else peer_hash
        self.policy = Policy(strict, _treatments(out_of_range, self.schema.head, self.schema.body))
        self._encode, self.encoder_source = compile_encoder(
            self.schema, self.policy, self.wire_hash, self._restart
        )
        self._decode, self.decoder_source = compile_decoder(self.schema, message_type, self.wire_hash)
        self._decode_head: Decoder | None = None
        self._batch: Batch | None = None
        self._cipher = None if insecure_passphrase is None else body_cipher(insecure_passphrase)

    @property
    def min_size(self) -> int:
        """The least size of a message of this type as DCCL reports it, bytes: with an id of one byte.

        What this type really takes is in info(): min_bytes, max_bytes.
        """
        return self.schema.reported_bytes[0]

    @property
    def max_size(self) -> int:
        """The greatest size of a message of this type as DCCL reports it, bytes: with an id of two."""
        return self.schema.reported_bytes[1]

    def info(self) -> SchemaInfo:
        """The bit budget: a row for each field, and the totals; str() of it is a table."""
        return describe(self.schema)

    def encode(self, message: M) -> bytes:
        """The message's bytes; EncodeError names the message, field, value and bound that do not agree."""
        return self._encode_into(message, Deviations([]))

    def encode_checked(self, message: M) -> Encoded:
        """The message's bytes, with a note of each value that was clamped, cut or sent as unset."""
        deviations = Deviations([])
        data = self._encode_into(message, deviations)
        return Encoded(data, tuple(deviations.found))

    def encode_head(self, message: M) -> bytes:
        """Only the id and the head fields."""
        return self.encode(message)[: self.schema.head_bytes]

    def decode(self, data: bytes, now_ns: int | None = None) -> M:
        """The message in `data`; DecodeError if it is none.

        now_ns: the receiver's Unix time, for messages with dccl.time fields.
        A field that the wire format loses (such as a required empty string in versions 2 and 3) is left
        unset, as in DCCL: ask IsInitialized().
        """
        message, size = self.decode_prefix(data, now_ns)
        if size != len(data) and self._is_strict:
            raise DecodeError(f"{len(data) - size} bytes follow the {size} of {self.schema.name}")
        return message

    def decode_prefix(self, data: bytes, now_ns: int | None = None) -> tuple[M, int]:
        """The message at the start of `data`, and how many bytes it takes."""
        return self._decode_with(self._decode, data, now_ns)

    def decode_head(self, data: bytes, now_ns: int | None = None) -> M:
        """The message's head fields only; what follows the head is neither needed nor read."""
        if self._decode_head is None:
            head = replace(self.schema, body=Message(self.schema.descriptor, ()))
            self._decode_head = compile_decoder(head, self.message_type, self.wire_hash)[0]
        return self._decode_with(self._decode_head, data[: self.schema.head_bytes], now_ns)[0]

    def encode_many(self, columns: Columns) -> Batch.Rows:
        """Many messages at once from columns of numbers: one row of bytes for each. See batch.Batch."""
        try:
            return self._batch_codec().encode(columns)
        except EncodeError as error:
            raise EncodeError(told_of(self.schema.name, error)) from error

    def decode_many(self, rows: Batch.Rows, now_ns: int | None = None) -> dict[str, Batch.Column]:
        """Columns of numbers from rows of bytes. See batch.Batch."""
        return self._batch_codec().decode(rows, None if now_ns is None else now_ns // _NS_PER_S)

    def _batch_codec(self) -> Batch:
        if self._batch is None:
            self._batch = Batch(self.schema, self.policy)
        return self._batch

    def _restart(self) -> None:
        for use in self._adaptive:
            use.begin()

    def _encode_into(self, message: M, deviations: Deviations) -> bytes:
        self.check(message)
        self._restart()
        try:
            data = self._encode(message, deviations)
        except (EncodeError, ConditionError) as error:
            raise EncodeError(told_of(self.schema.name, error)) from error
        for use in self._adaptive:
            use.commit()
        if self._cipher is None:
            return data
        head = data[: self.schema.head_bytes]
        return head + self._cipher(head, data[len(head) :])

    def check(self, message: M) -> None:
        """EncodeError for a message of another class, or without all of its required fields."""
        if message.__class__ is not self.message_type:
            given = message.DESCRIPTOR.full_name if isinstance(message, ProtobufMessage) else repr(message)
            raise EncodeError(
                f"{given} is not a message of the class that this codec has: {self.schema.name}"
            )
        if not message.IsInitialized():
            missing = ", ".join(message.FindInitializationErrors())  # type: ignore[attr-defined]
            raise EncodeError(f"{self.schema.name} misses required fields: {missing}")

    def _decode_with(self, decoder: Decoder, data: bytes, now_ns: int | None) -> tuple[M, int]:
        if self._cipher is not None:
            head = data[: self.schema.head_bytes]
            data = head + self._cipher(head, data[len(head) :])
        self._restart()
        try:
            decoded = decoder(data, now_ns)
        except (DecodeError, ConditionError, ValueError, OverflowError) as error:
            raise DecodeError(told_of(self.schema.name, error)) from error
        for use in self._adaptive:
            use.commit()
        return decoded  # type: ignore[return-value]


def _treatments(out_of_range: OutOfRange | None, *parts: Message) -> dict[str, Treatment]:
    if out_of_range is None:
        return {}
    given = {"*": out_of_range} if isinstance(out_of_range, str) else dict(out_of_range)
    known = {"*", *(field.path for part in parts for field in _leaves(part))}
    for path, treatment in given.items():
        if path not in known:
            raise SchemaError(f"out_of_range names {path!r}, which is no field; fields are {sorted(known)}")
        if treatment not in ("raise", "clamp", "dccl"):
            raise SchemaError(f"out_of_range of {path!r} = {treatment!r} is not raise, clamp or dccl")
    return given


def _leaves(message: Message) -> Iterable[Field]:
    for field in message.fields:
        if isinstance(field.wire, MessageWire):
            yield from _leaves(field.wire.message)
        else:
            yield field

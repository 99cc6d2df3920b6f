"""The seam for field codecs that are not DCCL's: one field, a message or a whole codec group."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Protocol

from google.protobuf.descriptor import FieldDescriptor

from messages.dccl.limits import Deviations, Treatment
from messages.dccl.options import FieldOptions


class BoundFieldCodec(Protocol):
    """A codec for one field of one schema. min_bits, max_bits: its least and greatest size.

    The value of a repeated field is the list of its elements; of an embedded message, the message. None
    stands for "unset".
    """

    min_bits: int
    max_bits: int

    def encode(self, value: Any) -> tuple[int, int]:
        """The value's bits as an integer (first bit lowest), and how many they are; or EncodeError."""
        ...

    def decode(self, bits: int, available: int) -> tuple[Any, int]:
        """The value at the low end of `bits`, and how many bits it took; or DecodeError.

        bits: all that is left of the message, this field first. available: how many of them were received;
        above them there are zeros.
        """
        ...


class FieldCodec(Protocol):
    """What a name in (dccl.field).codec, (dccl.msg).codec or codec_group stands for."""

    def bind(self, field: FieldDescriptor, options: FieldOptions) -> BoundFieldCodec | None:
        """The codec of this field, checked (SchemaError); None for DCCL's default codec of the version."""
        ...


FieldCodecs = Mapping[str, FieldCodec]

BoundEncoder = Callable[[Any, Deviations], tuple[int, int]]


class OwnFieldCodec(Protocol):
    """A field codec of straitlink.1: one that also knows what to do out of range, and the time.

    Its repr stands for what its bits mean, and for nothing else: schemas that differ there have another hash.
    """

    @property
    def min_bits(self) -> int:
        """Its least size."""
        ...

    @property
    def max_bits(self) -> int:
        """Its greatest size."""
        ...

    @property
    def shown(self) -> tuple[float, float, float] | None:
        """Minimum, maximum and resolution, for tables."""
        ...

    def encoder(self, path: str, treatment: Treatment, is_strict: bool) -> BoundEncoder:
        """As BoundFieldCodec.encode, for the field at a path."""
        ...

    def decode(self, bits: int, available: int, now_ns: int | None) -> tuple[Any, int]:
        """As BoundFieldCodec.decode. now_ns: the receiver's Unix time, if known."""
        ...

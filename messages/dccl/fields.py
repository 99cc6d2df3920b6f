"""A checked schema as plain values: messages, fields, and how each field lies on the wire."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from google.protobuf.descriptor import Descriptor, FieldDescriptor

from messages.dccl.custom import BoundFieldCodec, OwnFieldCodec
from messages.dccl.numeric import Numeric
from messages.dccl.options import Conditions, FieldOptions

Part = Literal["head", "body"]


@dataclass(frozen=True, slots=True)
class NumberWire:
    """A bounded number."""

    numeric: Numeric

    @property
    def size(self) -> tuple[int, int]:
        """Least and greatest size of a value, bits."""
        return self.numeric.bits, self.numeric.bits


@dataclass(frozen=True, slots=True)
class TimeWire:
    """Time of day, or within some days. conversion: the field's units in a second (1 or 1e6)."""

    numeric: Numeric
    conversion: float
    window_s: int
    is_integer: bool

    @property
    def size(self) -> tuple[int, int]:
        """Least and greatest size of a value, bits."""
        return self.numeric.bits, self.numeric.bits


@dataclass(frozen=True, slots=True)
class BoolWire:
    """false or true, or 0 for "unset" where the field is not required-like."""

    is_required: bool

    @property
    def size(self) -> tuple[int, int]:
        """Least and greatest size of a value, bits."""
        return (1, 1) if self.is_required else (2, 2)


@dataclass(frozen=True, slots=True)
class EnumWire:
    """A value's place in the declaration, or its number. numbers: wire integer - offset to enum number."""

    numeric: Numeric
    numbers: dict[int, int]

    @property
    def size(self) -> tuple[int, int]:
        """Least and greatest size of a value, bits."""
        return self.numeric.bits, self.numeric.bits


@dataclass(frozen=True, slots=True)
class TextWire:
    """String or bytes: a length of prefix_bits and so many bytes, or exactly max_length bytes (prefix 0)."""

    is_string: bool
    max_length: int
    prefix_bits: int
    empty_is_unset: bool

    @property
    def is_fixed(self) -> bool:
        """Whether all values take max_length bytes."""
        return self.prefix_bits == 0 and self.max_length > 0

    @property
    def size(self) -> tuple[int, int]:
        """Least and greatest size of a value, bits."""
        content = 8 * self.max_length
        return self.prefix_bits + (content if self.is_fixed else 0), self.prefix_bits + content


@dataclass(frozen=True, slots=True)
class StaticWire:
    """A value that both ends know: no bits."""

    value: object

    @property
    def size(self) -> tuple[int, int]:
        """Least and greatest size of a value, bits."""
        return 0, 0


@dataclass(frozen=True, slots=True)
class HashWire:
    """The low bits of the schema's hash, checked on decoding."""

    bits: int

    @property
    def size(self) -> tuple[int, int]:
        """Least and greatest size of a value, bits."""
        return self.bits, self.bits


@dataclass(frozen=True, slots=True)
class CustomWire:
    """A codec from outside of this package, or the arithmetic codec; it sees repeated fields as a whole."""

    codec: BoundFieldCodec

    @property
    def size(self) -> tuple[int, int]:
        """Least and greatest size of a value, bits."""
        return self.codec.min_bits, self.codec.max_bits


@dataclass(frozen=True, slots=True)
class OwnWire:
    """A codec of straitlink.1; it too sees repeated fields as a whole, and presence is its own affair."""

    codec: OwnFieldCodec

    @property
    def size(self) -> tuple[int, int]:
        """Least and greatest size of a value, bits."""
        return self.codec.min_bits, self.codec.max_bits


@dataclass(frozen=True, slots=True)
class MessageWire:
    """An embedded message, field after field in place."""

    message: Message

    @property
    def size(self) -> tuple[int, int]:
        """Least and greatest size of a value, bits."""
        return self.message.min_bits, self.message.max_bits


Wire = (
    NumberWire
    | TimeWire
    | BoolWire
    | EnumWire
    | TextWire
    | StaticWire
    | HashWire
    | CustomWire
    | OwnWire
    | MessageWire
)


@dataclass(frozen=True, slots=True)
class Field:
    """One field at one place of a message tree, in one part (head or body).

    path: names from the root, as in "pose.x". is_required: required-like, in DCCL's sense of the codec
    version. has_presence_bit: of the field, or of each element of a repeated field.
    min_repeat, max_repeat: of a repeated field, else None; count_bits: its length prefix.
    is_padded: version 2 writes max_repeat elements always, missing ones as "unset".
    when_required: the same field where a dynamic condition has made it required.
    """

    descriptor: FieldDescriptor
    path: str
    options: FieldOptions
    codec_name: str
    wire: Wire
    is_required: bool
    has_presence_bit: bool
    min_repeat: int | None = None
    max_repeat: int | None = None
    count_bits: int = 0
    is_padded: bool = False
    is_oneof_member: bool = False
    conditions: Conditions | None = None
    when_required: Field | None = None

    @property
    def name(self) -> str:
        """The field's name in its message."""
        return str(self.descriptor.name)

    @property
    def element_size(self) -> tuple[int, int]:
        """Least and greatest size of one element with its presence bit, bits."""
        low, high = self.wire.size
        return (1, high + 1) if self.has_presence_bit else (low, high)

    @property
    def size(self) -> tuple[int, int]:
        """Least and greatest size in a message, bits."""
        low, high = self.element_size
        if self.max_repeat is not None and not isinstance(self.wire, CustomWire | OwnWire):
            low = self.count_bits + low * (self.max_repeat if self.is_padded else self.min_repeat or 0)
            high = self.count_bits + high * self.max_repeat
        if self.when_required is not None:
            high = max(high, self.when_required.size[1])
        is_skippable = self.is_oneof_member or self.conditions is not None
        return (0 if is_skippable else low), high


@dataclass(frozen=True, slots=True)
class OneOf:
    """A oneof: the selector that precedes the fields of its message. members: names, in order."""

    name: str
    members: tuple[str, ...]
    bits: int


@dataclass(frozen=True, slots=True)
class Message:
    """The fields of one message at one place of the tree that belong to one part, in wire order."""

    descriptor: Descriptor
    fields: tuple[Field, ...]
    oneofs: tuple[OneOf, ...] = ()
    min_bits: int = field(init=False)
    max_bits: int = field(init=False)

    def __post_init__(self) -> None:
        selectors = sum(oneof.bits for oneof in self.oneofs)
        object.__setattr__(self, "min_bits", selectors + sum(f.size[0] for f in self.fields))
        always = sum(f.size[1] for f in self.fields if not f.is_oneof_member)
        object.__setattr__(self, "max_bits", selectors + always + sum(map(self._largest, self.oneofs)))

    @property
    def is_empty(self) -> bool:
        """Whether nothing of the message is in this part."""
        return not self.fields and not self.oneofs

    def _largest(self, oneof: OneOf) -> int:
        return max((f.size[1] for f in self.fields if f.name in oneof.members), default=0)

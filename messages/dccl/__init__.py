"""DCCL's wire format (codec versions 2, 3 and 4) in Python, with schemas compiled once. See docs/dccl.md."""

from messages.dccl.arithmetic import ArithmeticModel
from messages.dccl.codec import Codec, Encoded
from messages.dccl.custom import BoundFieldCodec, FieldCodec
from messages.dccl.errors import DcclError, DecodeError, EncodeError, SchemaError
from messages.dccl.info import FieldInfo, SchemaInfo
from messages.dccl.limits import Deviation
from messages.dccl.proto_file import load_proto, sendable_types

__all__ = [
    "ArithmeticModel",
    "BoundFieldCodec",
    "Codec",
    "DcclError",
    "DecodeError",
    "Deviation",
    "EncodeError",
    "Encoded",
    "FieldCodec",
    "FieldInfo",
    "SchemaError",
    "SchemaInfo",
    "load_proto",
    "sendable_types",
]

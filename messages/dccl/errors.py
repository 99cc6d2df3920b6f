"""What can go wrong with a DCCL schema, a message or its bytes.

DcclError
+-- SchemaError   our declaration: found when a schema is loaded
+-- EncodeError   our value: found when a message is encoded
+-- DecodeError   the peer's bytes: the only error of decoding
"""

from __future__ import annotations


class DcclError(Exception):
    """Base of this package's errors; each message names message, field, value and bound."""


class SchemaError(DcclError):
    """A message's declaration that DCCL refuses, or an extra that it needs and that is not installed."""


class EncodeError(DcclError):
    """A value that its field cannot carry, where the codec was told to raise."""


class DecodeError(DcclError):
    """Bytes that are not a whole, valid message of the type."""


def told_of(message: str, error: Exception) -> str:
    """An error's text with the name of the message that it befell, unless it says so by itself."""
    text = str(error)
    return text if message in text else f"{message}: {text}"

"""What can go wrong with a view or its bytes.

ViewCodecError
+-- EncodeError   our array or our request: found when a view is encoded
+-- DecodeError   the peer's bytes: the only error of decoding
"""

from __future__ import annotations


class ViewCodecError(Exception):
    """Base of this package's errors; each message names the field, its value and its bound."""


class EncodeError(ViewCodecError):
    """A view, or a wish about its encoding, that no codec can carry."""


class DecodeError(ViewCodecError):
    """Bytes that are not one whole, valid view."""

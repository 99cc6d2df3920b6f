"""What can go wrong, and whose fault it is.

ShaperError
    ConfigError   ours: a setting that cannot be; names file, field, value and what was expected
    DecodeError   the peer's: bytes that are no datagram of ours; caught at one place, counted
"""

from __future__ import annotations


class ShaperError(Exception):
    """Base of the package's errors."""


class ConfigError(ShaperError):
    """A setting that cannot be; the message names file, field, value and what was expected."""


class DecodeError(ShaperError):
    """Bytes from the link that are no well-formed datagram. Never leaves `Endpoint.receive_datagram`."""

"""The stamp that travels beside each payload on a local bus, as a Zenoh attachment."""

from __future__ import annotations

import struct
from dataclasses import dataclass

_OURS = struct.Struct("<qI")  # capture_ns, sequence
_RMW_ZENOH = struct.Struct("<qqB16s")  # sequence, source_ns, gid length, gid (rmw_zenoh_cpp)
MAX_SEQUENCE = 0xFFFF_FFFF


@dataclass(frozen=True, slots=True)
class Stamp:
    """When a sample was captured, and its number within its topic.

    capture_ns: nanoseconds since the Unix epoch, clock of the host that captured it.
    sequence: counts the topic's samples, modulo 2^32; 0 where nobody counts.
    """

    capture_ns: int
    sequence: int = 0

    def encode(self) -> bytes:
        """The 12 bytes of the attachment."""
        return _OURS.pack(self.capture_ns, self.sequence & MAX_SEQUENCE)


def decode_stamp(attachment: bytes) -> Stamp | None:
    """The stamp in an attachment of ours or of rmw_zenoh; None for anything else."""
    if len(attachment) == _OURS.size:
        capture_ns, sequence = _OURS.unpack(attachment)
        return Stamp(capture_ns, sequence)
    if len(attachment) == _RMW_ZENOH.size:
        sequence, source_ns, gid_bytes, _gid = _RMW_ZENOH.unpack(attachment)
        if gid_bytes == 16:
            return Stamp(source_ns, sequence & MAX_SEQUENCE)
    return None

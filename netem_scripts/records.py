"""What a link tells about itself: the same records from virtual time and from the UDP proxy."""

from __future__ import annotations

from typing import Literal, NamedTuple

from .band import Profile
from .link import DropReason
from .profile_file import profile_to_dict

Direction = Literal["down", "up"]


class StartRecord(NamedTuple):
    """First in a trace. t_ns: the trace's clock; unix_ns: the wall clock at the same instant."""

    t_ns: int
    unix_ns: int
    profile: Profile


class PacketRecord(NamedTuple):
    """One packet at its entry into the link; queue_delay_ns is what it waits there before its first bit."""

    t_ns: int
    direction: Direction
    wire_bytes: int
    queue_delay_ns: int
    dropped: DropReason | None


class BandRecord(NamedTuple):
    """A band begins; the first one as well."""

    t_ns: int
    direction: Direction
    rate_bps: int
    one_way_delay_ns: int


LinkRecord = StartRecord | PacketRecord | BandRecord


def event_of(record: LinkRecord) -> dict[str, object]:
    """The record as a line of the trace, ready for JSON."""
    match record:
        case PacketRecord(t_ns, direction, wire_bytes, queue_delay_ns, dropped):
            return {
                "event": "packet",
                "t_ns": t_ns,
                "direction": direction,
                "wire_bytes": wire_bytes,
                "queue_delay_ns": queue_delay_ns,
                "dropped": None if dropped is None else dropped.value,
            }
        case BandRecord():
            return {"event": "band", **record._asdict()}
        case StartRecord(t_ns, unix_ns, profile):
            return {
                "event": "start",
                "t_ns": t_ns,
                "unix_ns": unix_ns,
                "side": "link",
                "profile": profile_to_dict(profile),
            }

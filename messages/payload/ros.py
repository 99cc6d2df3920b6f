"""ROS 2 messages as CDR, without ROS."""

from __future__ import annotations

import struct
from functools import cache
from typing import Any

from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from messages.payload.topic_encoding import PayloadError

NS_PER_S = 1_000_000_000
_MAX_SECONDS = (1 << 31) - 1


def cdr(ros_type: str) -> str:
    """Zenoh's encoding string of a ROS 2 type."""
    return f"application/cdr;{ros_type}"


@cache
def ros_types() -> Typestore:
    """ROS 2's message definitions."""
    return get_typestore(Stores.LATEST)


def ros_class(ros_type: str) -> Any:
    """The class of a ROS 2 type, its fields in the order of the definition."""
    return ros_types().types[ros_type]


def read_cdr(payload: bytes, ros_type: str) -> Any:
    """A ROS 2 message from its CDR. Raises PayloadError."""
    try:
        return ros_types().deserialize_cdr(payload, ros_type)
    except Exception as error:  # readers are generated and raise what struct, numpy and codecs raise
        raise PayloadError(f"a payload of {len(payload)} bytes is no CDR of {ros_type}: {error}") from error


def write_cdr(message: object, ros_type: str) -> bytes:
    """A ROS 2 message as CDR, little-endian. Raises PayloadError for a number that its field cannot hold."""
    try:
        return bytes(ros_types().serialize_cdr(message, ros_type))
    except struct.error as error:
        raise PayloadError(f"{ros_type} cannot hold what came: {error}") from error


def ros_header(stamp_ns: int, frame_id: str = "") -> Any:
    """std_msgs/Header. Raises PayloadError for a time beyond its 32 bits of seconds."""
    seconds, nanoseconds = divmod(stamp_ns, NS_PER_S)
    if not -_MAX_SECONDS <= seconds <= _MAX_SECONDS:
        raise PayloadError(f"std_msgs/Header cannot hold a stamp of {seconds} s")
    return ros_class("std_msgs/msg/Header")(
        ros_class("builtin_interfaces/msg/Time")(seconds, nanoseconds), frame_id
    )


def stamp_ns_of(header: Any) -> int:
    """A std_msgs/Header's time, ns since the Unix epoch."""
    return int(header.stamp.sec) * NS_PER_S + int(header.stamp.nanosec)

"""The local Zenoh bus: the only file of the core packages that speaks to Zenoh."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import zenoh

# Two buses on one machine must meet only through the link. Scouting would let them find each other,
# and Zenoh's implicit shared memory would carry payloads of 3 kB and more around an emulated link.
_ISOLATION: dict[str, object] = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "transport/shared_memory/enabled": False,
}


@dataclass(frozen=True, slots=True)
class BusSettings:
    """Where a session of the local bus listens and connects.

    listen, connect: Zenoh endpoints such as "tcp/127.0.0.1:7447".
    options: Zenoh's own configuration by path ("transport/link/tx/queue/size/data"), passed through.
    """

    listen: Sequence[str] = ()
    connect: Sequence[str] = ()
    mode: str = "peer"
    options: Mapping[str, object] = field(default_factory=dict)


class BusError(Exception):
    """The local bus could not be opened; the message says which endpoint or option."""


def open_bus(settings: BusSettings) -> zenoh.Session:
    """Open an isolated session: explicit endpoints only, no scouting, no shared memory."""
    config = zenoh.Config()
    values: dict[str, object] = {
        "mode": settings.mode,
        **_ISOLATION,
        "listen/endpoints": list(settings.listen),
        "connect/endpoints": list(settings.connect),
        **settings.options,
    }
    for path, value in values.items():
        try:
            config.insert_json5(path, json.dumps(value))
        except zenoh.ZError as error:
            raise BusError(f"zenoh option {path} = {value!r} is refused: {error}") from error
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        where = f"listen {list(settings.listen)}, connect {list(settings.connect)}"
        raise BusError(f"cannot open the Zenoh bus ({where}): {error}") from error

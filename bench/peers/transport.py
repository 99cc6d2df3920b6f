"""What the benchmark asks of a stack: to take messages on one side and give them out on the other."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

from netem_scripts.network import OPERATOR_ADDRESS, ROBOT_ADDRESS
from straitlink.mission.load import Load

Side = Literal["robot", "operator"]
OnMessage = Callable[[str, bytes], None]
CONFIG_FOLDER = Path(__file__).parent / "config"


class Transport(Protocol):
    """One side of a stack. Callable from any thread; publish blocks where the stack's own does."""

    def publish(self, key: str, payload: bytes) -> None:
        """A sample of a topic of this side's direction."""

    def close(self) -> None:
        """End it; what has not left by now is lost."""


@dataclass(frozen=True, slots=True)
class Session:
    """What a stack is told at the start. on_message: called once for each message of the other side."""

    side: Side
    load: Load
    on_message: OnMessage

    @property
    def address(self) -> str:
        """Ours, in this side's network namespace."""
        return ROBOT_ADDRESS if self.side == "robot" else OPERATOR_ADDRESS

    @property
    def peer_address(self) -> str:
        """The other side's."""
        return OPERATOR_ADDRESS if self.side == "robot" else ROBOT_ADDRESS

    def keys(self, *, ours: bool) -> list[str]:
        """The topics that this side sends, or those that it receives."""
        direction = "down" if (self.side == "robot") == ours else "up"
        return [t.key for t in self.load.topics if t.direction == direction and t.traffic_class is not None]


@dataclass(frozen=True, slots=True)
class Peer:
    """A stack with one configuration. summary: how it is configured, and by whose advice."""

    name: str
    module: str
    summary: str

    def open(self, session: Session) -> Transport:
        """Start it; returns when it listens or has begun to connect."""
        module = importlib.import_module(f"bench.peers.{self.module}")
        transport: Transport = module.open_transport(self.name, session)
        return transport


PEERS = (
    Peer(
        "straitlink",
        "straitlink_shaper",
        "a Zenoh bus and a shaper on each side; one configuration for every link, no bands announced",
    ),
    Peer(
        "zenoh-tcp",
        "zenoh_peer",
        "Zenoh over one TCP link; priorities by topic, express, DROP for the camera and BLOCK for commands",
    ),
    Peer(
        "zenoh-two-tcp",
        "zenoh_peer",
        "Zenoh over two TCP links, one for the priorities above the camera's, small send buffer on the other",
    ),
    Peer(
        "zenoh-udp",
        "zenoh_peer",
        "Zenoh over UDP, priorities by topic, the camera downsampled to what the thin band carries",
    ),
    Peer(
        "foxglove",
        "foxglove_websocket",
        "foxglove-sdk's WebSocket server with its default backlog; commands by client publish",
    ),
    Peer(
        "cyclonedds",
        "cyclone_dds",
        "Cyclone DDS, best effort, keep last 1, transport priorities; unicast discovery",
    ),
    Peer("tcp", "tcp_stream", "one TCP connection, length-prefixed messages, TCP_NODELAY"),
    Peer(
        "quic",
        "quic_streams",
        "QUIC by aioquic: a stream for each topic of small messages, one for each image",
    ),
)


def peer_named(name: str) -> Peer:
    """Raises ValueError, which lists them."""
    for peer in PEERS:
        if peer.name == name:
            return peer
    raise ValueError(f"there is no peer {name!r}; there are {', '.join(p.name for p in PEERS)}")

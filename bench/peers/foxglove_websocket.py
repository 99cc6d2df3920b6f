"""foxglove-sdk: a server on the robot; the operator is a client that takes all and publishes commands.

The client speaks the Foxglove WebSocket protocol (docs.foxglove.dev, subprotocol foxglove.sdk.v1) over the
`websockets` package, as the Foxglove app does.
"""

from __future__ import annotations

import json
import struct
import threading
import time
from typing import Any

import foxglove
from foxglove.websocket import Capability, Client, ClientChannel, ServerListener
from websockets.sync.client import ClientConnection, connect

from bench.peers.transport import OnMessage, Session

_PORT = 8765
_OPAQUE = foxglove.Schema(name="bytes", encoding="", data=b"")
_MESSAGE_DATA = 1  # binary opcode, both ways
_SERVER_HEAD = struct.Struct("<BIQ")  # opcode, subscription, log time
_CLIENT_HEAD = struct.Struct("<BI")  # opcode, channel


class FoxgloveServer(ServerListener):
    """The robot's side."""

    def __init__(self, session: Session) -> None:
        self._on_message = session.on_message
        self._topics: dict[tuple[int, int], str] = {}
        self._channels = {
            key: foxglove.Channel(key, schema=_OPAQUE, message_encoding="opaque")
            for key in session.keys(ours=True)
        }
        self._server = foxglove.start_server(
            name="bench",
            host=session.address,
            port=_PORT,
            capabilities=[Capability.ClientPublish],
            supported_encodings=["opaque"],
            server_listener=self,
        )

    def on_client_advertise(self, client: Client, channel: ClientChannel) -> None:
        """The operator has a topic."""
        self._topics[(client.id, channel.id)] = channel.topic

    def on_message_data(self, client: Client, client_channel_id: int, data: bytes) -> None:
        """The operator has sent."""
        key = self._topics.get((client.id, client_channel_id))
        if key is not None:
            self._on_message(key, bytes(data))

    def publish(self, key: str, payload: bytes) -> None:
        """log() of the topic's channel."""
        self._channels[key].log(payload)

    def close(self) -> None:
        """Stop serving."""
        self._server.stop()


class FoxgloveClient:
    """The operator's side."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._lock = threading.Lock()
        self._connection = _connect(session.peer_address)
        self._channel_ids = {key: number for number, key in enumerate(session.keys(ours=True), start=1)}
        channels = [
            {"id": number, "topic": key, "encoding": "opaque", "schemaName": ""}
            for key, number in self._channel_ids.items()
        ]
        self._connection.send(json.dumps({"op": "advertise", "channels": channels}))
        threading.Thread(target=_receive, args=(self._connection, session.on_message), daemon=True).start()

    def publish(self, key: str, payload: bytes) -> None:
        """A binary frame; blocks while the socket's buffer is full."""
        with self._lock:
            self._connection.send(_CLIENT_HEAD.pack(_MESSAGE_DATA, self._channel_ids[key]) + payload)

    def close(self) -> None:
        """The process ends with it."""


def _connect(address: str) -> ClientConnection:
    deadline_s = time.monotonic() + 10
    while True:
        try:
            return connect(
                f"ws://{address}:{_PORT}",
                subprotocols=["foxglove.sdk.v1"],  # type: ignore[list-item]
                max_size=None,
                open_timeout=10,
                ping_interval=None,
                compression=None,
            )
        except OSError:
            if time.monotonic() > deadline_s:
                raise
            time.sleep(0.2)


def _receive(connection: ClientConnection, on_message: OnMessage) -> None:
    topics: dict[int, str] = {}
    for frame in connection:
        if isinstance(frame, str):
            _subscribe(connection, json.loads(frame), topics)
        elif frame[0] == _MESSAGE_DATA:
            _, subscription, _ = _SERVER_HEAD.unpack_from(frame)
            on_message(topics[subscription], frame[_SERVER_HEAD.size :])


def _subscribe(connection: ClientConnection, message: dict[str, Any], topics: dict[int, str]) -> None:
    if message.get("op") != "advertise":
        return
    wanted = []
    for channel in message["channels"]:
        number = len(topics) + 1
        topics[number] = channel["topic"]
        wanted.append({"id": number, "channelId": channel["id"]})
    connection.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))


def open_transport(_name: str, session: Session) -> FoxgloveServer | FoxgloveClient:
    """The robot serves, the operator connects."""
    return FoxgloveServer(session) if session.side == "robot" else FoxgloveClient(session)

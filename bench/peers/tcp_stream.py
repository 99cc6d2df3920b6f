"""One TCP connection with length-prefixed messages: what is written in an afternoon."""

from __future__ import annotations

import socket
import struct
import threading
import time

from bench.peers.transport import OnMessage, Session

_PORT = 7500
_HEAD = struct.Struct("<BI")  # bytes of the key, bytes of the payload


class TcpStream:
    """publish blocks while the kernel's send buffer is full."""

    def __init__(self, connection: socket.socket, on_message: OnMessage) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._connection = connection
        self._lock = threading.Lock()
        threading.Thread(target=_receive, args=(connection, on_message), daemon=True).start()

    def publish(self, key: str, payload: bytes) -> None:
        """Into the socket, behind whatever is there."""
        name = key.encode()
        with self._lock:
            self._connection.sendall(_HEAD.pack(len(name), len(payload)) + name + payload)

    def close(self) -> None:
        """The process ends with it."""
        self._connection.close()


def _receive(connection: socket.socket, on_message: OnMessage) -> None:
    with connection.makefile("rb") as stream:
        while head := stream.read(_HEAD.size):
            name_bytes, payload_bytes = _HEAD.unpack(head)
            key = stream.read(name_bytes).decode()
            on_message(key, stream.read(payload_bytes))


def open_transport(_name: str, session: Session) -> TcpStream:
    """The operator listens, the robot connects."""
    if session.side == "operator":
        with socket.create_server((session.address, _PORT)) as server:
            server.settimeout(20)
            connection, _ = server.accept()
        connection.settimeout(None)
        return TcpStream(connection, session.on_message)
    deadline_s = time.monotonic() + 10
    while True:
        try:
            return TcpStream(socket.create_connection((session.peer_address, _PORT)), session.on_message)
        except ConnectionRefusedError:
            if time.monotonic() > deadline_s:
                raise
            time.sleep(0.2)

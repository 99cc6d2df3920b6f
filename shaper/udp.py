"""The UDP socket of the link, on asyncio."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from typing import cast

_BUFFER_BYTES = 1 << 20  # the socket's own buffers: a link's worth of seconds, so that none is lost here


class UdpError(Exception):
    """The socket could not be opened; the message says which address and why."""


class UdpLink(asyncio.DatagramProtocol):
    """Datagrams to and from one peer. What anybody else sends is counted and dropped.

    An unreachable peer is no error: the link may be down, or the other side not started yet.
    """

    def __init__(self, peer: tuple[str, int], on_datagram: Callable[[bytes], None]) -> None:
        self.strangers = 0
        self.send_errors = 0
        self._peer = peer
        self._on_datagram = on_datagram
        self._transport: asyncio.DatagramTransport | None = None

    @classmethod
    async def open(
        cls, listen: tuple[str, int], peer: tuple[str, int], on_datagram: Callable[[bytes], None]
    ) -> UdpLink:
        """Bind and be ready. Raises UdpError."""
        loop = asyncio.get_running_loop()
        try:
            family, _, _, _, resolved = (await loop.getaddrinfo(*peer, type=socket.SOCK_DGRAM))[0]
        except socket.gaierror as error:
            raise UdpError(f"link.peer = {peer[0]}:{peer[1]}: the host is not known: {error}") from error
        link = cls((str(resolved[0]), int(resolved[1])), on_datagram)
        try:
            await loop.create_datagram_endpoint(lambda: link, local_addr=listen, family=family)
        except OSError as error:
            reason = "the port is in use" if error.errno == 98 else error.strerror or str(error)
            raise UdpError(f"link.listen = {listen[0]}:{listen[1]}: {reason}") from error
        return link

    def send(self, datagram: bytes) -> None:
        """Hand a datagram to the kernel."""
        if self._transport is not None:
            self._transport.sendto(datagram, self._peer)

    def close(self) -> None:
        """Close the socket; nothing leaves from now on."""
        if self._transport is not None:
            self._transport.close()
            self._transport = None  # asyncio itself would still send until the loop turns

    # asyncio.DatagramProtocol

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast(asyncio.DatagramTransport, transport)  # no subclass of it in CPython 3.11
        sock: socket.socket = transport.get_extra_info("socket")
        for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
            sock.setsockopt(socket.SOL_SOCKET, option, _BUFFER_BYTES)

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        if addr[:2] != self._peer:
            self.strangers += 1
            return
        self._on_datagram(data)

    def error_received(self, exc: Exception) -> None:
        self.send_errors += 1  # mostly "connection refused": nobody listens there at the moment

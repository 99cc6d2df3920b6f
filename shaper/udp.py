"""The UDP socket of the link, on asyncio."""

from __future__ import annotations

import asyncio
import ctypes
import errno
import socket
import struct
import sys
import time
from collections.abc import Callable

from shaper.secure_channel import Address
from shaper.socket_filter import SO_ATTACH_FILTER, Admission, encode_program, filter_program

_BUFFER_BYTES = 1 << 20  # the socket's own buffers: a link's worth of seconds, so that none is lost here
_MAX_BYTES = 65_535
_ANCILLARY_BYTES = socket.CMSG_SPACE(16)  # one time stamp
_BATCH = 64  # datagrams that are read before the loop looks at anything else

_TIMESTAMP = 35  # Linux's SO_TIMESTAMPNS and SCM_TIMESTAMPNS: the wall clock at which the kernel had it
_TIMESPEC = struct.Struct("@ll")
_MTU_DISCOVER = {  # Linux: level, option and value of "never in pieces, whatever is known of the path"
    socket.AF_INET: (socket.IPPROTO_IP, 10, 3),
    socket.AF_INET6: (socket.IPPROTO_IPV6, 23, 3),
}
_NS_PER_S = 1_000_000_000
_MAX_WAIT_NS = _NS_PER_S  # a datagram that seems to have waited longer met a step of the wall clock

Datagrams = list[tuple[bytes, Address, int]]
"""Each with its source, and when the kernel had it, in ns of the monotonic clock."""


class UdpError(Exception):
    """The socket could not be opened; the message says which address and why."""


class UdpLink:
    """Datagrams to and from whomever; the channel behind it knows who may be heard.

    peer: the other side's configured address, resolved. An unreachable peer is no error: the link may be
    down, or the other side not started yet. Where the kernel stamps what arrives (Linux), a busy event
    loop does not make a datagram look late. There no datagram leaves in pieces either: one that is too
    large for the path is lost, by which its size is known to be too large (RFC 8899, section 3).
    """

    def __init__(self, sock: socket.socket, peer: Address, on_datagrams: Callable[[Datagrams], None]) -> None:
        self.send_errors = 0
        self.peer = peer
        self._socket: socket.socket | None = sock
        self._on_datagrams = on_datagrams
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(sock, self._on_readable)

    @classmethod
    async def open(cls, listen: Address, peer: Address, on_datagrams: Callable[[Datagrams], None]) -> UdpLink:
        """Bind and be ready. on_datagrams: takes what has gathered, with its sources. Raises UdpError."""
        loop = asyncio.get_running_loop()
        try:
            family, _, _, _, resolved = (await loop.getaddrinfo(*peer, type=socket.SOCK_DGRAM))[0]
        except socket.gaierror as error:
            raise UdpError(f"link.peer = {peer[0]}:{peer[1]}: the host is not known: {error}") from error
        sock = socket.socket(family, socket.SOCK_DGRAM)
        try:
            sock.setblocking(False)
            if sys.platform == "linux":
                sock.setsockopt(socket.SOL_SOCKET, _TIMESTAMP, 1)
                sock.setsockopt(*_MTU_DISCOVER[family])
            for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):
                sock.setsockopt(socket.SOL_SOCKET, option, _BUFFER_BYTES)
            bind_to = await loop.getaddrinfo(*listen, family=family, type=socket.SOCK_DGRAM)
            sock.bind(bind_to[0][4])
        except OSError as error:
            sock.close()
            reason = error.strerror or str(error)
            reason = "the port is in use" if error.errno == errno.EADDRINUSE else reason
            raise UdpError(f"link.listen = {listen[0]}:{listen[1]}: {reason}") from error
        return cls(sock, (str(resolved[0]), int(resolved[1])), on_datagrams)

    def send(self, datagram: bytes, address: Address) -> None:
        """Hand a datagram to the kernel; what it cannot take is lost, as on the link."""
        if self._socket is None:
            return
        try:
            self._socket.sendto(datagram, address)
        except OSError:
            self.send_errors += 1  # mostly "connection refused": nobody listens there at the moment

    def take_only(self, admission: Admission) -> bool:
        """Have the kernel drop what cannot be the peer's (`shaper.socket_filter`); False if it cannot."""
        program = encode_program(filter_program(admission))
        buffer = ctypes.create_string_buffer(program)
        count = len(program) // 8
        if self._socket is None or sys.platform != "linux":
            return False
        try:
            head = struct.pack("HP", count, ctypes.addressof(buffer))
            self._socket.setsockopt(socket.SOL_SOCKET, SO_ATTACH_FILTER, head)
        except OSError:
            return False
        return True

    def hand_to(self, on_datagrams: Callable[[Datagrams], None]) -> None:
        """Somebody else takes from now on what gathers."""
        self._on_datagrams = on_datagrams

    def close(self) -> None:
        """Close the socket; nothing leaves from now on."""
        if self._socket is not None:
            self._loop.remove_reader(self._socket)
            self._socket.close()
            self._socket = None

    def _on_readable(self) -> None:
        gathered: Datagrams = []
        now_ns, unix_ns = time.monotonic_ns(), time.time_ns()
        for _ in range(_BATCH):
            assert self._socket is not None, "a closed socket has no reader"
            try:
                data, ancillary, _, source = self._socket.recvmsg(_MAX_BYTES, _ANCILLARY_BYTES)
            except (BlockingIOError, InterruptedError):
                break
            except OSError:  # an answer to something that we sent earlier
                self.send_errors += 1
                continue
            waited_ns = unix_ns - _stamped_unix_ns(ancillary, unix_ns)
            if not 0 <= waited_ns <= _MAX_WAIT_NS:  # came while we read, or the wall clock was stepped
                waited_ns = 0
            gathered.append((data, (source[0], source[1]), now_ns - waited_ns))
        if gathered:
            self._on_datagrams(gathered)


def _stamped_unix_ns(ancillary: list[tuple[int, int, bytes]], otherwise_ns: int) -> int:
    """When the kernel had a datagram, by its wall clock."""
    for level, kind, data in ancillary:
        if (level, kind) == (socket.SOL_SOCKET, _TIMESTAMP) and len(data) >= _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack_from(data)
            return int(seconds) * _NS_PER_S + int(nanoseconds)
    return otherwise_ns

"""The channel of a link without a key: datagrams pass as they are. For loopback, tests and simulations."""

from __future__ import annotations

from collections import deque

from shaper.carousel_wire import CLEAR, NUMBER_BITS, decode_clear, encode_clear
from shaper.errors import DecodeError
from shaper.flood_gate import Unwanted
from shaper.handshake import Identity
from shaper.notices import Notice
from shaper.secure_channel import Address, Control


class OpenChannel:
    """Takes what comes from the configured address, and nothing from any other."""

    overhead_bytes = 0
    has_control = False
    ready = True
    numbers_drawn = 0
    peers: tuple[Address, ...] = ()
    peer: Identity | None = None

    def __init__(self, peer: Address) -> None:
        self.peer_address = peer
        self.last_heard_ns: int | None = None
        self.notices: deque[Notice] = deque()
        self.strangers = 0
        self.unwanted = Unwanted()
        self._carousel_number = 0

    def counters_dict(self) -> dict[str, int]:
        """Counters by name."""
        return {"strangers": self.strangers}

    def session_ids(self) -> list[int]:
        """None: there are no sessions."""
        return []

    def set_wall_clock(self, unix_ns: int, now_ns: int) -> None:
        """It tells no times."""

    def seal(self, datagram: bytes, number: int) -> bytes:
        """The datagram as it is."""
        return datagram

    def seal_control(self, payload: bytes) -> bytes:
        """An open channel has nothing to say of its own."""
        raise AssertionError("an open channel carries no control datagrams")

    def seal_carousel(self, body: bytes) -> bytes | None:
        """The body as it is, under a head that says so."""
        number, self._carousel_number = self._carousel_number, self._carousel_number + 1
        return encode_clear(0, number & (1 << NUMBER_BITS) - 1) + body

    def open_carousel(self, data: bytes) -> bytes | None:
        """The body, whoever has sent it: on loopback only."""
        try:
            decode_clear(data)
        except DecodeError:
            self.strangers += 1
            return None
        return data[CLEAR.size :]

    def copy_to(self, datagram_bytes: int) -> Address | None:
        """None: the peer never moves."""
        return None

    def next_handshake(self, now_ns: int) -> tuple[bytes, Address] | None:
        """None: nobody proves anything."""
        return None

    def wakeup_at_ns(self) -> int | None:
        """Never by itself."""
        return None

    def receive(self, data: bytes, source: Address, now_ns: int) -> bytes | Control | None:
        """The datagram, if it comes from the peer's address."""
        if source != self.peer_address:
            self.strangers += 1
            return None
        self.last_heard_ns = now_ns
        return data

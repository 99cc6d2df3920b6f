"""Handshakes that others start: which of them are answered."""

from __future__ import annotations

from collections.abc import Mapping

from shaper.channel_notices import ChannelNotices
from shaper.errors import DecodeError
from shaper.flood_gate import Unwanted
from shaper.handshake import Hello, Side, check_key, decode_hello, decode_initiation, other_side, prologue
from shaper.link_key import ID_BYTES, LinkKey
from shaper.noise import KEY_BYTES, Responder
from shaper.rate_limit import RateLimit
from shaper.whereabouts import Address

_REMEMBERED = 512


class Initiations:
    """Judges them: by a known key, never seen before, and not too many of them.

    failed, refused: counts of those under another key or none, and of those repeated or beyond a limit.
    """

    def __init__(
        self, side: Side, keys: Mapping[bytes, LinkKey], notices: ChannelNotices, now_ns: int
    ) -> None:
        self.failed = 0
        self.refused = 0
        self.unwanted = Unwanted()
        self._side = side
        self._keys = keys
        self._checks = {key.id: check_key(key) for key in keys.values()}
        self._notices = notices
        self._seen_ephemerals: dict[bytes, None] = {}
        # One limit for the peer's address, one for everybody else: neither can use up the other's.
        self._read_limits = (RateLimit(200, 50, now_ns), RateLimit(200, 50, now_ns))
        self._answer_limits = (RateLimit(10, 10, now_ns), RateLimit(5, 10, now_ns))

    def check_of(self, key: LinkKey) -> bytes:
        """What initiations under a key are checked with."""
        return self._checks[key.id]

    def read(
        self, data: bytes, source: Address, now_ns: int, *, of_peer: bool
    ) -> tuple[Responder, Hello, LinkKey] | None:
        """What answers it, and what it says; None if it is not to be answered. of_peer: by its source."""
        before = self.failed + self.refused
        try:
            found = self._read(data, source, 0 if of_peer else 1, now_ns)
        except DecodeError:
            found = None
            self.failed += 1
        unwanted = self.failed + self.refused - before
        if of_peer:
            self.unwanted.of_peer += unwanted
        else:
            self.unwanted.initiations += unwanted
        return found

    def _read(
        self, data: bytes, source: Address, known: int, now_ns: int
    ) -> tuple[Responder, Hello, LinkKey] | None:
        key_id = data[1 : 1 + ID_BYTES]
        key = self._keys.get(key_id)
        if key is None:
            self._notices.unknown_key(key_id, [each.name for each in self._keys.values()], source, now_ns)
            raise DecodeError(f"an initiation under key {key_id.hex()}, which is not among ours")
        try:
            message = decode_initiation(data, self._checks[key_id])
            ephemeral = message[:KEY_BYTES]
            if ephemeral in self._seen_ephemerals or not self._read_limits[known].allows(now_ns):
                self.refused += 1
                return None
            responder = Responder(key.secret, prologue(other_side(self._side)))
            hello = decode_hello(responder.read(message))
        except DecodeError:
            self._notices.wrong_key(key, self._side, source, now_ns)
            raise
        if not self._answer_limits[known].allows(now_ns):
            self.refused += 1
            return None
        if len(self._seen_ephemerals) >= _REMEMBERED:
            del self._seen_ephemerals[next(iter(self._seen_ephemerals))]
        self._seen_ephemerals[ephemeral] = None
        return responder, hello, key

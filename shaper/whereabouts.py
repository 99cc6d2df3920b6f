"""Where the peer is: it is followed to another address only once it has answered from there.

Whoever hears the peer's datagrams may pass one on from an address of his own, or of somebody whom he
wants to be flooded. So an address that is new is on trial (RFC 9000, sections 8.2 and 9.3): it gets a
challenge that only the peer can answer, and until then a copy of what leaves, all at most three times
what has come from there; the peer's own address goes on getting all of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from shaper.session import CLEAR_BYTES, TAG_BYTES

Address = tuple[str, int]

TOKEN_BYTES = 8
_CHALLENGE_DATAGRAM_BYTES = CLEAR_BYTES + 1 + TOKEN_BYTES + TAG_BYTES
_AMPLIFICATION = 3  # RFC 9000, section 8.1
_CHALLENGE_AGAIN_NS = 100_000_000


@dataclass(slots=True)
class _Trial:
    """An address from which the peer's datagrams have begun to come. allowed_bytes: may still go there."""

    address: Address
    token: bytes
    allowed_bytes: int = 0
    challenged_ns: int = -(1 << 62)


class Whereabouts:
    """The peer's address, and one that may become it.

    configured: where the peer is looked for until it is heard from elsewhere.
    """

    def __init__(self, configured: Address, random_bytes: Callable[[int], bytes]) -> None:
        self.configured = configured
        self.address = configured
        self._random = random_bytes
        self._trial: _Trial | None = None

    def on_heard(self, source: Address, datagram_bytes: int, now_ns: int) -> bytes | None:
        """The peer's newest datagram came from there; the token to challenge that address with, if any.

        One at a time, and no sooner than 100 ms after the last: a lost one is made good by the next
        datagram.
        """
        if source == self.address:
            self._trial = None  # it is where it was
            return None
        trial = self._trial
        if trial is None or trial.address != source:
            trial = self._trial = _Trial(source, self._random(TOKEN_BYTES))
        trial.allowed_bytes += _AMPLIFICATION * datagram_bytes
        if now_ns - trial.challenged_ns < _CHALLENGE_AGAIN_NS:
            return None
        trial.challenged_ns = now_ns
        trial.allowed_bytes -= _CHALLENGE_DATAGRAM_BYTES
        return trial.token

    def on_answer(self, source: Address, token: bytes) -> bool:
        """Whether a challenge is answered from where it was sent to: then the peer is there now."""
        trial = self._trial
        if trial is None or trial.address != source or trial.token != token:
            return False
        return self.move(source)

    def move(self, address: Address) -> bool:
        """The peer is proven to be there; whether that is news."""
        moved = address != self.address
        self.address, self._trial = address, None
        return moved

    def copy_to(self, datagram_bytes: int) -> Address | None:
        """An address on trial that gets a copy of what leaves now, if that is within its allowance."""
        trial = self._trial
        if trial is None or trial.allowed_bytes < datagram_bytes:
            return None
        trial.allowed_bytes -= datagram_bytes
        return trial.address

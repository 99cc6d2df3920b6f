"""Sealing a carousel's datagrams under keys that the two-way link has agreed.

A link without a way back cannot agree on keys. The thin link beside it can: each of its sessions leaves,
beside the two keys of its own datagrams, a secret for other uses (the third output of Noise's last HKDF).
The carousel's key of a session and sender is drawn from that. So the carousel needs no key of its own, both
ends are proven, keys change and are forgotten with the session, and a recording cannot be read later.

The nonce rule: a datagram's number is its nonce; it counts from 0 in each session and never goes back; the
key is of this session and sender only. A sender that starts anew has a new session, so no number is ever
used twice under a key. AES-256 in CCM mode with a tag of eight bytes, as the session's other datagrams.
"""

from __future__ import annotations

import hmac

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESCCM

from shaper.carousel_wire import CLEAR, NUMBER_BITS, decode_clear, encode_clear
from shaper.errors import DecodeError
from shaper.handshake import Side
from shaper.serial_number import ReceivedWindow

TAG_BYTES = 8
_NONCE_BYTES = 13
_WINDOW = 4096  # datagrams that may overtake each other: 0.2 s of 300 Mbit/s


class CarouselSeal:
    """One session's keys for carousels, by who sends. secret: the session's, for other uses."""

    __slots__ = ("_number", "_secret", "_sides", "_window")

    def __init__(self, secret: bytes) -> None:
        self._secret = secret
        self._sides: dict[Side, AESCCM] = {}
        self._number = 0
        self._window = ReceivedWindow(_WINDOW)

    def seal(self, body: bytes, session_id: int, sender: Side) -> bytes:
        """Protect what a carousel sends. session_id: by which the receiver knows the session."""
        number, self._number = self._number, self._number + 1
        if number >> NUMBER_BITS:
            raise ValueError(f"datagram {number} of a session: a key seals at most 2^{NUMBER_BITS}")
        clear = encode_clear(session_id, number)
        return clear + self._cipher(sender).encrypt(_nonce(number), body, clear)

    def open(self, data: bytes, sender: Side) -> bytes | None:
        """What was sealed; None if it came before. Raises DecodeError if that sender has not sealed it."""
        _, number = decode_clear(data)
        clear = data[: CLEAR.size]
        try:
            body = self._cipher(sender).decrypt(_nonce(number), data[CLEAR.size :], clear)
        except InvalidTag as error:
            raise DecodeError("a carousel's datagram that the peer has not sealed") from error
        return body if self._window.accept(number) else None

    def _cipher(self, sender: Side) -> AESCCM:
        cipher = self._sides.get(sender)
        if cipher is None:
            key = hmac.digest(self._secret, b"straitlink carousel 1, from the " + sender.encode(), "sha256")
            cipher = self._sides[sender] = AESCCM(key, tag_length=TAG_BYTES)
        return cipher


def _nonce(number: int) -> bytes:
    return number.to_bytes(_NONCE_BYTES, "little")

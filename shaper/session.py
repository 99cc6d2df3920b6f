"""One pair of keys in use: sealing and opening datagrams, each at most once.

    protected datagram  0x02 and the plain one's flags · session number 2 · packet number 3 · sealed · tag 8
    control datagram    0x05 · session number 2 · its own packet number 3 · sealed · tag 8

The first six bytes are authenticated, the rest is encrypted too: AES-256 in CCM mode with a tag of eight
bytes. A key seals each packet number once, and fewer than 2^23 of them.
"""

from __future__ import annotations

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESCCM

from shaper.carousel_seal import CarouselSeal
from shaper.errors import DecodeError
from shaper.frames import NUMBER_BITS, VERSION
from shaper.handshake import Hello, Side
from shaper.noise import TransportKeys
from shaper.serial_number import ReceivedWindow, expand

PROTECTED, CONTROL = 0x02, 0x05
CLEAR_BYTES = 6
TAG_BYTES = 8
MAX_SEALED = 1 << 23  # packet numbers under one key: no two have the same low 24 bits
MAX_FORGED = 1 << 20  # failed tags after which a key should be replaced
_KIND_MASK, _FLAGS_MASK = 0x0F, 0xF0
_NONCE_BYTES = 13  # leaves a length field of two bytes: datagrams are no longer
_NONCE_HEADS = {PROTECTED: bytes(_NONCE_BYTES - 3), CONTROL: b"\1" + bytes(_NONCE_BYTES - 4)}


class Session:
    """Keys that one handshake has made, and what has been said under them.

    own_id: how the peer addresses it. hello: what the peer told of itself. key_name: of the link key that
    the handshake was made with. answered_to: where our answer went; None if this side has started it.
    """

    __slots__ = (
        "_control_number",
        "_first_number",
        "_last_number",
        "_open",
        "_peer_epoch",
        "_peer_id",
        "_seal",
        "_windows",
        "answered_to",
        "carousel",
        "forged",
        "hello",
        "key_name",
        "made_ns",
        "own_id",
        "proven",
        "used_ns",
    )

    def __init__(
        self,
        own_id: int,
        hello: Hello,
        keys: TransportKeys,
        key_name: str,
        *,
        now_ns: int,
        answered_to: tuple[str, int] | None = None,
    ) -> None:
        self.own_id = own_id
        self.hello = hello
        self.answered_to = answered_to
        self.key_name = key_name
        self.made_ns = now_ns
        self.used_ns = now_ns  # something was opened
        self.proven = False  # the peer has sealed something
        self.forged = 0
        self.carousel = CarouselSeal(keys.exporter)
        self._peer_epoch = hello.identity.epoch.to_bytes(2, "little")
        self._peer_id = hello.session_id.to_bytes(2, "little")
        self._seal = AESCCM(keys.send, tag_length=TAG_BYTES)
        self._open = AESCCM(keys.receive, tag_length=TAG_BYTES)
        self._windows = {PROTECTED: ReceivedWindow(), CONTROL: ReceivedWindow()}
        self._first_number: int | None = None
        self._last_number = -1
        self._control_number = 0

    @property
    def sealed(self) -> int:
        """How many packet numbers lie behind this key, of the kind that has used more."""
        data = 0 if self._first_number is None else self._last_number - self._first_number + 1
        return max(data, self._control_number)

    @property
    def worn(self) -> bool:
        """Nothing more is sealed: the next key is overdue, and a number must not come again."""
        return self.sealed >= MAX_SEALED

    def seal(self, datagram: bytes, number: int) -> bytes:
        """Protect a plain datagram whose packet number, in full, is `number`."""
        assert datagram[0] & _KIND_MASK == VERSION, "only datagrams of the present version are sealed"
        if self._first_number is None:
            self._first_number = number
        if number <= self._last_number or number - self._first_number >= MAX_SEALED:
            raise ValueError(f"packet number {number} after {self._last_number}: a key seals each only once")
        self._last_number = number
        clear = bytes([PROTECTED | datagram[0] & _FLAGS_MASK]) + self._peer_id + datagram[3:6]
        return clear + self._seal.encrypt(_NONCE_HEADS[PROTECTED] + clear[3:6], datagram[CLEAR_BYTES:], clear)

    def seal_control(self, payload: bytes) -> bytes:
        """Protect what the two channels tell each other beside the endpoints' datagrams."""
        if self._control_number >= MAX_SEALED:
            raise ValueError(f"control number {self._control_number}: a key seals fewer than {MAX_SEALED}")
        number = self._control_number.to_bytes(NUMBER_BITS // 8, "little")
        self._control_number += 1
        clear = bytes([CONTROL]) + self._peer_id + number
        return clear + self._seal.encrypt(_NONCE_HEADS[CONTROL] + clear[3:6], payload, clear)

    def seal_carousel(self, body: bytes, side: Side) -> bytes:
        """Protect what this side's carousel sends on the link without a way back."""
        return self.carousel.seal(body, self.hello.session_id, side)

    def open(self, data: bytes, now_ns: int) -> tuple[bytes, bool] | None:
        """The plain datagram or control payload, and whether it is the newest; None if it came before.

        Raises DecodeError if it was not sealed by the peer. A plain datagram gets its epoch back.
        """
        clear, kind = data[:CLEAR_BYTES], data[0] & _KIND_MASK
        try:
            body = self._open.decrypt(_NONCE_HEADS[kind] + clear[3:6], data[CLEAR_BYTES:], clear)
        except InvalidTag as error:
            self.forged += 1
            raise DecodeError(f"session {self.own_id}: a datagram that the peer has not sealed") from error
        window = self._windows[kind]
        low_bits = int.from_bytes(clear[3:6], "little")
        near = 1 << NUMBER_BITS if window.highest < 0 else window.highest
        number = low_bits + near if window.highest < 0 else expand(low_bits, NUMBER_BITS, near)
        newest = number > window.highest
        if not window.accept(number):
            return None
        self.proven = True
        self.used_ns = now_ns
        if kind == CONTROL:
            return body, newest
        return bytes([VERSION | clear[0] & _FLAGS_MASK]) + self._peer_epoch + clear[3:6] + body, newest

"""Noise_NNpsk0_25519_ChaChaPoly_SHA256: two messages after which both sides hold fresh keys.

Both know a 32-byte key beforehand. The first message proves that its sender knows it, the second that the
other side does and is there now; the first datagram under the new keys proves the same of the first
side. Names and order of operations are those of the Noise Protocol Framework, revision 34, sections 5
and 9; tests/golden/noise.json holds its public test vectors. Randomness is passed in.
"""

from __future__ import annotations

import hashlib
import hmac
from copy import copy
from dataclasses import dataclass

from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey, X25519PublicKey
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305

from shaper.errors import DecodeError

PROTOCOL_NAME = b"Noise_NNpsk0_25519_ChaChaPoly_SHA256"
KEY_BYTES = 32
TAG_BYTES = 16
OVERHEAD_BYTES = KEY_BYTES + TAG_BYTES  # of either message, beside its payload


@dataclass(frozen=True, slots=True)
class TransportKeys:
    """What the handshake leaves: a key for each direction, and a hash of all that was said.

    exporter: a secret from which keys for other uses of the session are drawn; the output that HKDF would
    give after those two, so neither says anything of the others.
    """

    send: bytes
    receive: bytes
    handshake_hash: bytes
    exporter: bytes


class Initiator:
    """Writes the first message and reads the second."""

    def __init__(self, psk: bytes, prologue: bytes, ephemeral: bytes) -> None:
        self._state = _SymmetricState(prologue)
        self._state.mix_key_and_hash(psk)
        self._ephemeral = X25519PrivateKey.from_private_bytes(ephemeral)

    def write(self, payload: bytes) -> bytes:
        """The message that opens the handshake."""
        public = self._ephemeral.public_key().public_bytes_raw()
        self._state.mix_ephemeral(public)
        return public + self._state.encrypt_and_hash(payload)

    def read(self, message: bytes) -> tuple[bytes, TransportKeys]:
        """The answer's payload and the keys. Raises DecodeError, and still takes the true answer then."""
        state = copy(self._state)
        remote = _read_ephemeral(state, message)
        state.mix_key(_agree(self._ephemeral, remote))
        payload = state.decrypt_and_hash(message[KEY_BYTES:])
        ours, theirs, exporter = state.split()
        return payload, TransportKeys(ours, theirs, state.hash, exporter)


class Responder:
    """Reads the first message and writes the second."""

    def __init__(self, psk: bytes, prologue: bytes) -> None:
        self._state = _SymmetricState(prologue)
        self._state.mix_key_and_hash(psk)
        self._remote = b""

    def read(self, message: bytes) -> bytes:
        """The first message's payload: its sender knows the key, but may be repeating an old message.

        Costs no elliptic curve. Raises DecodeError.
        """
        self._remote = _read_ephemeral(self._state, message)
        return self._state.decrypt_and_hash(message[KEY_BYTES:])

    def write(self, payload: bytes, ephemeral: bytes) -> tuple[bytes, TransportKeys]:
        """The answer, and the keys. Raises DecodeError where the other side's ephemeral key is none."""
        private = X25519PrivateKey.from_private_bytes(ephemeral)
        public = private.public_key().public_bytes_raw()
        self._state.mix_ephemeral(public)
        self._state.mix_key(_agree(private, self._remote))
        message = public + self._state.encrypt_and_hash(payload)
        theirs, ours, exporter = self._state.split()
        return message, TransportKeys(ours, theirs, self._state.hash, exporter)


class _SymmetricState:
    """Chaining key, hash of the transcript, and the key of the moment (section 5.2)."""

    def __init__(self, prologue: bytes) -> None:
        self.hash = hashlib.sha256(PROTOCOL_NAME).digest()  # the name is longer than a hash
        self._chaining_key = self.hash
        self._cipher: ChaCha20Poly1305 | None = None
        self._nonce = 0
        self._mix_hash(prologue)

    def mix_key(self, material: bytes) -> None:
        self._chaining_key, key = _hkdf(self._chaining_key, material, 2)
        self._cipher, self._nonce = ChaCha20Poly1305(key), 0

    def mix_key_and_hash(self, material: bytes) -> None:
        self._chaining_key, hashed, key = _hkdf(self._chaining_key, material, 3)
        self._mix_hash(hashed)
        self._cipher, self._nonce = ChaCha20Poly1305(key), 0

    def mix_ephemeral(self, public: bytes) -> None:
        """With a pre-shared key an ephemeral one goes into the chaining key too (section 9.2)."""
        self._mix_hash(public)
        self.mix_key(public)

    def encrypt_and_hash(self, plaintext: bytes) -> bytes:
        assert self._cipher is not None, "NNpsk0 has a key before it has anything to say"
        sealed = self._cipher.encrypt(self._next_nonce(), plaintext, self.hash)
        self._mix_hash(sealed)
        return sealed

    def decrypt_and_hash(self, sealed: bytes) -> bytes:
        assert self._cipher is not None, "NNpsk0 has a key before it has anything to read"
        try:
            plaintext = self._cipher.decrypt(self._next_nonce(), sealed, self.hash)
        except InvalidTag as error:
            raise DecodeError("a handshake message is not from a holder of the link key") from error
        self._mix_hash(sealed)
        return plaintext

    def split(self) -> tuple[bytes, bytes, bytes]:
        first, second, third = _hkdf(self._chaining_key, b"", 3)
        return first, second, third

    def _mix_hash(self, data: bytes) -> None:
        self.hash = hashlib.sha256(self.hash + data).digest()

    def _next_nonce(self) -> bytes:
        nonce = bytes(4) + self._nonce.to_bytes(8, "little")
        self._nonce += 1
        return nonce


def _read_ephemeral(state: _SymmetricState, message: bytes) -> bytes:
    if len(message) < OVERHEAD_BYTES:
        raise DecodeError(f"a handshake message of {len(message)} bytes is shorter than {OVERHEAD_BYTES}")
    remote = message[:KEY_BYTES]
    state.mix_ephemeral(remote)
    return remote


def _agree(private: X25519PrivateKey, public: bytes) -> bytes:
    try:
        return private.exchange(X25519PublicKey.from_public_bytes(public))
    except ValueError as error:  # a point of small order: the result would be zero whatever our key
        raise DecodeError("an ephemeral key of the handshake is of small order") from error


def _hkdf(chaining_key: bytes, material: bytes, outputs: int) -> tuple[bytes, ...]:
    """HKDF with HMAC-SHA256 as section 4.3 has it."""
    secret = hmac.digest(chaining_key, material, "sha256")
    made: list[bytes] = []
    for index in range(1, outputs + 1):
        made.append(hmac.digest(secret, (made[-1] if made else b"") + bytes([index]), "sha256"))
    return tuple(made)

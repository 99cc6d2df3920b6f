"""DCCL's payload encryption, for talking to systems that use it.

Not for new traffic: AES-256 in counter mode with its counter taken from a hash of the head, so that two
messages with the same head are encrypted with the same key stream, and their difference is readable. There
is no authentication either: a flipped bit of the body arrives as a flipped bit. The link's own protection
(shaper.secure_channel) has neither fault.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable

from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes


def body_cipher(passphrase: str) -> Callable[[bytes, bytes], bytes]:
    """A function of head and body bytes that encrypts the body, and decrypts it likewise."""
    key = algorithms.AES(hashlib.sha256(passphrase.encode()).digest())

    def apply(head: bytes, body: bytes) -> bytes:
        counter = hashlib.sha256(head).digest()[:16]
        stream = Cipher(key, modes.CTR(counter)).encryptor()
        return stream.update(body) + stream.finalize()

    return apply

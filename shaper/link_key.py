"""The key that the two ends of a link share, as a line of text.

    straitlink-link-key-1 <identifier, 8 hex digits> <key, 64 hex digits> <check, 8 hex digits>

The identifier travels in the open, so that each side can say which key the other one uses; it is random
and says nothing of the key. The check catches a line that was copied badly.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Callable
from dataclasses import dataclass, field

from shaper.errors import ConfigError

ID_BYTES = 4
SECRET_BYTES = 32
_FORMAT = "straitlink-link-key-1"
_CHECK_BYTES = 4


@dataclass(frozen=True, slots=True)
class LinkKey:
    """A key and the identifier by which both sides call it. The secret never shows in a repr."""

    id: bytes
    secret: bytes = field(repr=False)

    def __post_init__(self) -> None:
        if len(self.id) != ID_BYTES or len(self.secret) != SECRET_BYTES:
            raise ValueError(
                f"a link key has {ID_BYTES} bytes of identifier and {SECRET_BYTES} of key, "
                f"not {len(self.id)} and {len(self.secret)}"
            )

    @property
    def name(self) -> str:
        """The identifier for people."""
        return self.id.hex()


def make_link_key(random_bytes: Callable[[int], bytes]) -> LinkKey:
    """A new key from the operating system's randomness (`secrets.token_bytes`)."""
    return LinkKey(random_bytes(ID_BYTES), random_bytes(SECRET_BYTES))


def format_link_key(key: LinkKey) -> str:
    """The line of a key file, without the line's end."""
    return f"{_FORMAT} {key.id.hex()} {key.secret.hex()} {_check(key).hex()}"


def parse_link_key(text: str, where: str) -> LinkKey:
    """The key of a key file; lines that start with # say what it is for.

    where: the file, for messages. Raises ConfigError, which never quotes the text.
    """
    lines = [line.strip() for line in text.splitlines()]
    words = " ".join(line for line in lines if line and not line.startswith("#")).split()
    if len(words) != 4 or words[0] != _FORMAT:
        raise ConfigError(f"{where}: is no link key: expected what `straitlink keygen FILE` writes")
    try:
        key_id, secret, check = (bytes.fromhex(word) for word in words[1:])
        key = LinkKey(key_id, secret)
    except ValueError as error:
        raise ConfigError(
            f"{where}: the link key is damaged: copy the file from the other side again"
        ) from error
    if not hmac.compare_digest(check, _check(key)):
        raise ConfigError(f"{where}: the link key's check does not match: copy the file again")
    return key


def _check(key: LinkKey) -> bytes:
    return hashlib.sha256(_FORMAT.encode() + key.id + key.secret).digest()[:_CHECK_BYTES]

"""Key files: written for their owner's eyes only, and read only if they are."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from shaper.errors import ConfigError
from shaper.link_key import LinkKey, format_link_key, parse_link_key

_MODE = 0o600
_MAX_BYTES = 4096


def write_key_file(path: Path, key: LinkKey) -> None:
    """Create a key file, readable by its owner only. Raises ConfigError if there is one already."""
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, _MODE)
    except FileExistsError as error:
        raise ConfigError(f"{path}: exists: a key that may be in use is not overwritten") from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error
    with os.fdopen(descriptor, "w") as file:
        os.fchmod(file.fileno(), _MODE)  # whatever the umask says
        file.write(f"# key {key.name} of one robot-operator link: the same file on both sides, mode 0600\n")
        file.write(format_link_key(key) + "\n")


def read_key_file(path: Path) -> LinkKey:
    """The key in a file that only its owner can read. Raises ConfigError: what is wrong and what to do."""
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except FileNotFoundError as error:
        raise ConfigError(
            f"{path}: there is no such key file: make one with `straitlink keygen {path}` on one side and "
            "copy it to the other"
        ) from error
    except OSError as error:
        raise ConfigError(f"{path}: the key file cannot be read: {error.strerror}") from error
    with os.fdopen(descriptor, "rb") as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode):
            raise ConfigError(f"{path}: is not a file: expected what `straitlink keygen FILE` writes")
        others = stat.S_IMODE(status.st_mode) & 0o077
        if others:
            raise ConfigError(
                f"{path}: mode {stat.S_IMODE(status.st_mode):04o} lets others read or change the link key: "
                f"run `chmod 600 {path}`, and make a new key if anybody may have read it"
            )
        text = file.read(_MAX_BYTES).decode("utf-8", "replace")
    return parse_link_key(text, str(path))

"""Key files: made once, readable by their owner only, and refused with a sentence otherwise."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from shaper.errors import ConfigError
from shaper.key_file import read_key_file, write_key_file
from shaper.link_key import LinkKey, format_link_key, make_link_key, parse_link_key

KEY = make_link_key(random.Random(1).randbytes)


def test_a_key_file_gives_its_key_back_and_is_for_its_owner_only(tmp_path: Path) -> None:
    path = tmp_path / "link.key"
    write_key_file(path, KEY)
    assert path.stat().st_mode & 0o777 == 0o600
    assert read_key_file(path) == KEY


@pytest.mark.parametrize("mode", [0o644, 0o640, 0o604, 0o622])
def test_a_file_that_others_may_read_is_refused_with_what_to_do(tmp_path: Path, mode: int) -> None:
    path = tmp_path / "link.key"
    write_key_file(path, KEY)
    path.chmod(mode)
    with pytest.raises(ConfigError, match=rf"mode {mode:04o} .*chmod 600 .*link\.key"):
        read_key_file(path)


def test_a_key_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "link.key"
    write_key_file(path, KEY)
    with pytest.raises(ConfigError, match="exists"):
        write_key_file(path, KEY)


def test_a_missing_file_says_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="straitlink keygen"):
        read_key_file(tmp_path / "none.key")


def test_every_damaged_character_of_a_line_is_noticed() -> None:
    line = format_link_key(KEY)
    for at in range(len(line)):
        damaged = line[:at] + ("0" if line[at] != "0" else "1") + line[at + 1 :]
        with pytest.raises(ConfigError) as error:
            parse_link_key(damaged, "link.key")
        assert KEY.secret.hex()[8:16] not in str(error.value)


def test_a_secret_never_shows_in_a_repr() -> None:
    assert KEY.secret.hex() not in repr(KEY) and repr(KEY.secret) not in repr(KEY)


def test_a_key_of_another_length_is_our_own_mistake() -> None:
    with pytest.raises(ValueError, match="32 of key"):
        LinkKey(KEY.id, bytes(16))

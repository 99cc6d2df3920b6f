"""Link profiles in CSV, as a spreadsheet or a measurement writes them: a row is a band."""

from __future__ import annotations

import csv
import tomllib
from pathlib import Path
from typing import Any

from .band import Profile, ProfileError
from .profile_file import profile_from_dict

_DIRECTIONS = ("down", "up", "both")


def read_csv_profile(path: Path) -> Profile:
    """The profile in a CSV file; its name is the file's.

    The header names the fields of a band as in TOML, and `direction` (down, up or both; both where the column
    is missing). Lines before it that begin with # are the top of the profile in TOML: `# buffer_s = 10`. An
    empty cell leaves the field at its default. Raises ProfileError, which names file, field, value and bound.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except OSError as error:
        raise ProfileError(f"{path}: the link profile cannot be read: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise ProfileError(f"{path}: the link profile is not text: {error}.") from error
    top = "\n".join(line[1:].strip() for line in lines if line.startswith("#"))
    try:
        values: dict[str, Any] = tomllib.loads(top)
    except tomllib.TOMLDecodeError as error:
        raise ProfileError(f"{path}: the lines that begin with # are not TOML: {error}.") from error
    rows = csv.DictReader(line for line in lines if line.strip() and not line.startswith("#"))
    for number, row in enumerate(rows, start=1):
        where = f"{path}: row {number}"
        direction = (row.pop("direction", None) or "both").strip()
        if direction not in _DIRECTIONS:
            raise ProfileError(f"{where}: direction = {direction} must be one of {', '.join(_DIRECTIONS)}.")
        band = _band(where, row)
        for each in ("down", "up") if direction == "both" else (direction,):
            values.setdefault(each, {}).setdefault("band", []).append(band)
    return profile_from_dict(values, where=str(path), name=path.stem)


def _band(where: str, row: dict[str, Any]) -> dict[str, Any]:
    if None in row:
        raise ProfileError(f"{where}: it has more cells than the header has names.")
    return {field.strip(): _value(text.strip()) for field, text in row.items() if text and text.strip()}


def _value(text: str) -> object:
    """A cell as TOML would read it; what TOML does not know is text, for the check of the field to refuse."""
    try:
        return tomllib.loads(f"value = {text.lower()}")["value"]
    except tomllib.TOMLDecodeError:
        return text

"""Numbers for schedules that look random and are the same everywhere and for ever."""

from __future__ import annotations

import hashlib


def uniform(label: str) -> float:
    """A number in [0, 1) that depends on the label alone, evenly spread over labels."""
    return int.from_bytes(hashlib.sha256(label.encode()).digest()[:7], "big") / (1 << 56)
